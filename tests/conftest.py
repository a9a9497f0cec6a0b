"""Strictness for every test: two CPU devices, no silent broadcasting or promotion, shapes checked.

After each module the compiled programs are dropped: a worker that kept them all would grow to several GB.
"""

import gc
import os

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"

from jaxtyping import install_import_hook

import tests.typecheck  # noqa: F401 (the hook finds it by name)

install_import_hook("jaxsr", "tests.typecheck.check")

import hypothesis  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

hypothesis.settings.register_profile(
    "jaxsr",
    deadline=None,
    max_examples=15,
    derandomize=True,
    suppress_health_check=list(hypothesis.HealthCheck),
)
hypothesis.settings.load_profile("jaxsr")


@pytest.fixture(scope="module", autouse=True)
def drop_compiled_programs():
    """See the docstring of the module."""
    yield
    jax.clear_caches()
    gc.collect()
