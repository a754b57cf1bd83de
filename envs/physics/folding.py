"""Constant folding: jax's elementwise primitives on numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

# Constants count as equal, as 0 or as 1 if they differ by at most this many units in the last place of their terms.
# Otherwise the rounding of 1 / sqrt(2) in a quaternion, for example, would leave terms that are really 0.
ROUNDING = 4


def fold(op: str, *args: Any, dtype: np.dtype, params: tuple = ()) -> Any:
    """The value of a primitive on numpy arrays or Python numbers; a Python number if all operands are."""
    with np.errstate(all="ignore"):
        value = np.asarray(NUMPY[op](*args, **dict(params)), dtype=dtype)
    if op in ("add", "sub") and dtype.kind == "f":
        value = snap(value, np.maximum(*map(np.abs, args)))
    return value if value.ndim or any(isinstance(arg, np.ndarray) for arg in args) else value.item()


def snap(result: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Sets sums of constants to exactly 0 if they are within the rounding of terms of this size."""
    return np.where(np.abs(result) < ROUNDING * np.finfo(result.dtype).eps * size, 0, result).astype(result.dtype)


def add_constants(a: float, b: float, dtype: np.dtype) -> float:
    """a + b for constants next to an expression of this dtype; 0 if it is 0 up to rounding."""
    result = a + b
    return 0 * result if is_close(a, -b, dtype) else result


def is_close(a: float, b: float, dtype: np.dtype) -> bool:
    """Whether two constants next to an expression of this dtype are equal up to rounding."""
    if dtype.kind != "f":
        return a == b
    return abs(a - b) <= ROUNDING * float(np.finfo(dtype).eps) * max(abs(a), abs(b))


NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": lambda x, y: np.true_divide(x, y) if np.result_type(x, y).kind == "f" else np.trunc(np.true_divide(x, y)),
    "rem": np.fmod,
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": lambda x, rounding_method: np.round(x) if rounding_method == 1 else np.trunc(x + np.copysign(0.5, x)),
    "max": np.maximum,
    "min": np.minimum,
    "pow": np.power,
    "integer_pow": lambda x, y: np.power(x, float(y)),
    "square": np.square,
    "sqrt": np.sqrt,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "cbrt": np.cbrt,
    "exp": np.exp,
    "exp2": np.exp2,
    "log": np.log,
    "expm1": np.expm1,
    "log1p": np.log1p,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "logistic": lambda x: 1 / (1 + np.exp(-x)),
    "is_finite": np.isfinite,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "nextafter": np.nextafter,
    "select_n": lambda which, off, on, *others: (
        np.choose(which, (off, on, *others)) if others else np.where(which, on, off)
    ),
    "stop_gradient": lambda x: x,
    "convert_element_type": lambda x, new_dtype: x,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
}
