"""What a method costs: parameters, multiply-adds counted from the program itself, and the time of a frame.

Only convolutions and matrix products count: what papers' tables hold, and what a network spends its time on.
Filters and gathers, as of the methods without a network, are written in other operations and count nothing.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import prod
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from jaxsr.errors import JaxsrError


@dataclass(frozen=True)
class Cost:
    """Of a method at some size."""

    parameters: int
    """Numbers that are learned; running averages of batch norm are not."""
    multiply_adds_per_px: float
    """Of convolutions and matrix products for one frame, divided by the number of its HR pixels."""


@dataclass(frozen=True)
class Timing:
    """Time of one frame. Compilation happens once and is never part of the median."""

    compile_s: float
    """Seconds of compilation alone, before the first call."""
    median_ms: float
    """Median time of one frame in milliseconds."""
    spread_ms: float
    """Interquartile range of the time of one frame in milliseconds."""


def count_parameters(net: Any) -> int:
    """Learned numbers in a state of a network (`nnx.state`); 0 for None.

    Running averages of batch norm (`nnx.BatchStat`) and random states are not learned.
    """
    from flax import nnx

    if net is None:
        return 0
    return sum(int(np.size(leaf)) for leaf in jax.tree.leaves(nnx.filter_state(net, nnx.Param)))


def count_multiply_adds(function: Callable[..., Any], *args: Any) -> int:
    """Multiply-adds of the convolutions and matrix products in one call of a function.

    Counted from its jaxpr, that is before the compiler; nothing is computed. Loops of a known number of turns
    count as often, of a conditional the costliest branch counts. A product with a zero of the padding counts,
    as is usual; one with a zero between the samples of a transposed convolution does not.

    Args:
        function: pure, traceable.
        *args: pytrees of arrays, or of `jax.ShapeDtypeStruct`.

    Raises:
        JaxsrError: a loop with an unknown number of turns multiplies something.
    """
    return multiply_adds_of(jax.make_jaxpr(function)(*args).jaxpr)


def multiply_adds_of(jaxpr: Jaxpr) -> int:
    """`count_multiply_adds` of a program that was traced already."""
    return sum(_multiply_adds(equation) for equation in jaxpr.eqns)


def _multiply_adds(equation: JaxprEqn) -> int:
    name, params = equation.primitive.name, equation.params
    if name == "conv_general_dilated":
        return _convolution(equation)
    if name == "dot_general":
        ((contracted, _), _) = params["dimension_numbers"]
        left = _shape(equation.invars[0])
        return prod(_shape(equation.outvars[0])) * prod(left[axis] for axis in contracted)
    inner = [multiply_adds_of(jaxpr) for jaxpr in _jaxprs(params)]
    total: int = sum(inner)
    if name == "cond":
        return max(inner)
    if name == "scan":
        return params["length"] * total
    if name == "while" and total:
        raise JaxsrError(
            "cannot count a loop with an unknown number of turns",
            where="count_multiply_adds",
            expected="jax.lax.scan, or fori_loop with constant bounds",
        )
    return total


def _convolution(equation: JaxprEqn) -> int:
    params, numbers = equation.params, equation.params["dimension_numbers"]
    kernel, out = _shape(equation.invars[1]), _shape(equation.outvars[0])
    batch, channels, *rows = (out[axis] for axis in numbers.out_spec)
    _, inputs, *kernel_rows = (kernel[axis] for axis in numbers.rhs_spec)  # inputs of one group
    count = batch * channels * inputs
    for axis, (size, taps) in enumerate(zip(rows, kernel_rows, strict=True)):
        # Along each axis: how often a tap meets a sample, and not a zero that was put between samples.
        at = np.arange(size)[:, None] * params["window_strides"][axis]
        at = at + np.arange(taps)[None] * params["rhs_dilation"][axis] - params["padding"][axis][0]
        count *= int(np.sum(at % params["lhs_dilation"][axis] == 0))
    return count


def _shape(variable: Any) -> tuple[int, ...]:
    return variable.aval.shape


def _jaxprs(params: dict[str, Any]) -> Iterator[Jaxpr]:
    """Programs inside an operation: of a jitted function, a loop, a branch, a custom derivative."""
    for value in params.values():
        for item in value if isinstance(value, list | tuple) else (value,):
            if isinstance(item, ClosedJaxpr):
                yield item.jaxpr
            elif isinstance(item, Jaxpr):
                yield item
