"""Jax's elementwise primitives on scalars, simplified as far as possible."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from envs.physics.algebra import add, cos, div, integer_pow, mul, neg, power, sin, sub
from envs.physics.expressions import Expression, Scalar, build, identity, is_constant, is_number, is_operation
from envs.physics.folding import fold


class UnsupportedPrimitiveError(ValueError):
    """A primitive, or a use of one, that has no scalar form; the message begins with its name."""


def apply(op: str, *args: Scalar, dtype: np.dtype, params: tuple = ()) -> Scalar:
    """The simplified expression of a primitive in `folding.NUMPY`; a Python number if all operands are."""
    if all(map(is_constant, args)):
        return fold(op, *args, dtype=dtype, params=params)
    if op == "select_n":
        return select(*args, dtype=dtype)
    simplify = SIMPLIFY.get(op)
    if simplify is not None:
        return simplify(*args, **dict(params))
    return build(op, *args, dtype=dtype, params=params)


def select(which: Scalar, on_false: Scalar, on_true: Scalar, *others: Scalar, dtype: np.dtype | None = None) -> Scalar:
    """`on_true` if `which` is true, else `on_false`; with more cases, the one with index `which`."""
    if others:
        return choose(which, on_false, on_true, *others, dtype=dtype)
    if is_constant(which):
        return on_true if which else on_false
    if identity(on_false) == identity(on_true):
        return on_true
    if on_false is False and on_true is True:
        return which
    if is_operation(which, "not"):
        return select(which.args[0], on_true, on_false, dtype=dtype)
    return build("select_n", which, on_false, on_true, dtype=dtype)


def choose(index: Scalar, *cases: Scalar, dtype: np.dtype | None) -> Scalar:
    """cases[index], with the index clamped to the valid range, by bisection of the runs of equal cases."""
    starts = [i for i, case in enumerate(cases) if i == 0 or identity(case) != identity(cases[i - 1])]

    def among(first: int, last: int) -> Scalar:
        if first == last:
            return cases[starts[first]]
        middle = (first + last + 1) // 2
        is_upper = apply("ge", index, starts[middle], dtype=np.dtype(bool))
        return select(is_upper, among(first, middle - 1), among(middle, last), dtype=dtype)

    return among(0, len(starts) - 1)


def maximum(x: Scalar, y: Scalar) -> Scalar:
    """max(x, y); max(-inf, x) = x."""
    return _extremum("max", -math.inf, x, y)


def minimum(x: Scalar, y: Scalar) -> Scalar:
    """min(x, y); min(inf, x) = x."""
    return _extremum("min", math.inf, x, y)


def _extremum(op: str, neutral: float, x: Scalar, y: Scalar) -> Scalar:
    if is_constant(y):
        x, y = y, x
    return y if x is y or is_number(x, neutral) else build(op, x, y)


def clamp(low: Scalar, x: Scalar, high: Scalar) -> Scalar:
    """min(max(x, low), high)."""
    return minimum(high, maximum(low, x))


def logical_and(x: Scalar, y: Scalar) -> Scalar:
    """x and y, logical or bitwise; x and x = x."""
    return _logical("and", True, x, y)


def logical_or(x: Scalar, y: Scalar) -> Scalar:
    """x or y, logical or bitwise; x or x = x."""
    return _logical("or", False, x, y)


def _logical(op: str, neutral: bool, x: Scalar, y: Scalar) -> Scalar:
    if is_constant(x):
        x, y = y, x
    if x is y or y is neutral:
        return x
    return y if y is (not neutral) else build(op, x, y)


def logical_not(x: Expression) -> Scalar:
    """not x, logical or bitwise; not not x = x."""
    return x.args[0] if x.op == "not" else build("not", x)


def stop_gradient(x: Expression) -> Scalar:
    """x without its derivatives, of which an integer has none."""
    return x if x.op == "stop_gradient" or x.dtype.kind != "f" else build("stop_gradient", x)


def convert(x: Expression, new_dtype: np.dtype) -> Scalar:
    """x converted to another dtype; unchanged if it has this dtype."""
    if x.dtype == new_dtype:
        return x
    dtype = np.dtype(new_dtype)
    return build("convert_element_type", x, dtype=dtype, params=(("new_dtype", dtype),))


SIMPLIFY: dict[str, Callable[..., Any]] = {
    "add": add,
    "sub": sub,
    "mul": mul,
    "div": div,
    "neg": neg,
    "pow": power,
    "integer_pow": integer_pow,
    "square": lambda x: mul(x, x),
    "sin": sin,
    "cos": cos,
    "max": maximum,
    "min": minimum,
    "clamp": clamp,
    "and": logical_and,
    "or": logical_or,
    "not": logical_not,
    "stop_gradient": stop_gradient,
    "convert_element_type": convert,
}
