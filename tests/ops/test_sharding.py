import functools
import re

import jax
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from tests.ops.examples import examples, total

EXAMPLES = examples()


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_batch_keeps_its_sharding(name):
    """Forward and gradient of a batch over two devices: nothing is exchanged, results lie where inputs do."""
    example = EXAMPLES[name]
    sharding = NamedSharding(Mesh(np.array(jax.devices()[:2]), ("data",)), PartitionSpec("data"))
    arguments = jax.device_put(example.arguments, sharding)

    @jax.jit
    def both(*arguments):
        if not example.differentiable:
            return example.fn(*arguments)
        moved = [arguments[i] for i in example.differentiable]
        curved = functools.partial(total, example._replace(arguments=arguments))
        return example.fn(*arguments), jax.grad(curved)(moved)

    compiled = both.lower(*arguments).compile()
    exchanged = re.findall("all-gather|all-to-all|collective-permute|all-reduce", compiled.as_text())
    assert not exchanged
    for result in jax.tree.leaves(compiled(*arguments)):
        assert result.sharding.is_equivalent_to(sharding, result.ndim)
