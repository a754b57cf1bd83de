"""Sums, products, quotients and powers of scalar expressions, simplified by the rules for real numbers.

x + 0, x 1, x 0, x - x, x / x, c (d x), a x + b x, signs pulled outwards, sin^2 + cos^2, ...

The simplifications differ from floating point in rounding, in the sign of zero, and if an operand is infinite or NaN,
or a fraction is 0 / 0: 0 x is 0 here, and can be NaN in floating point. A NaN that matters still shows in the result,
since every term that does not vanish for real numbers is still computed.
"""

from __future__ import annotations

import math
from typing import overload

import numpy as np

from envs.physics.expressions import Expression, Scalar, build, is_constant, is_number, is_operation
from envs.physics.folding import add_constants, fold, is_close


@overload
def split_coefficient(x: Expression) -> tuple[float, Expression]: ...
@overload
def split_coefficient(x: Scalar) -> tuple[float, Scalar]: ...
def split_coefficient(x: Scalar) -> tuple[float, Scalar]:
    """(c, y) with x = c y, where c is a constant and y has no constant factor."""
    if is_operation(x, "neg"):
        c, y = split_coefficient(x.args[0])
        return -c, y
    if is_operation(x, "mul") and is_constant(x.args[0]):
        return x.args
    return 1, x


@overload
def split_constant(x: Expression) -> tuple[float, Expression]: ...
@overload
def split_constant(x: Scalar) -> tuple[float, Scalar]: ...
def split_constant(x: Scalar) -> tuple[float, Scalar]:
    """(c, y) with x = c + y, where c is a constant and y has no constant term."""
    if is_operation(x, "add") and is_constant(x.args[0]):
        return x.args
    if is_operation(x, "sub") and is_constant(x.args[0]):
        return x.args[0], neg(x.args[1])
    return 0, x


# --- sums -------------------------------------------------------------------------------------------------------------


@overload
def neg(x: Expression) -> Expression: ...
@overload
def neg(x: Scalar) -> Scalar: ...
def neg(x: Scalar) -> Scalar:
    """-x; -(-x) = x, -(x - y) = y - x, -(c + x) = -c - x."""
    if is_constant(x):
        return -x
    if x.op == "neg":
        return x.args[0]
    if x.op == "sub":
        return add(neg(x.args[0]), x.args[1]) if is_constant(x.args[0]) else build("sub", x.args[1], x.args[0])
    if x.op == "add" and is_constant(x.args[0]):
        return build("sub", -x.args[0], x.args[1])
    return build("neg", x)


def add(x: Scalar, y: Scalar) -> Scalar:
    """x + y, as a difference if one is negative; collects constants and factors out common factors."""
    if is_constant(x):
        return _shift(x, y)
    if is_constant(y):
        return _shift(y, x)
    (a, u), (b, v) = split_constant(x), split_constant(y)
    if not (is_number(a, 0) and is_number(b, 0)):
        return _shift(add_constants(a, b, x.dtype), add(u, v))
    if is_operation(x, "neg"):
        return sub(y, x.args[0])
    if is_operation(y, "neg"):
        return sub(x, y.args[0])
    product = _common_factor(x, y, 1)
    return build("add", x, y) if product is None else product


def sub(x: Scalar, y: Scalar) -> Scalar:
    """x - y = x + (-y), written as a difference."""
    if is_constant(x):
        return x - y if is_constant(y) else add(x, neg(y))
    if x is y:
        return x.dtype.type(0).item()
    if is_constant(y) or is_operation(y, "neg"):
        return add(x, neg(y))
    (a, u), (b, v) = split_constant(x), split_constant(y)
    if not (is_number(a, 0) and is_number(b, 0)):
        return _shift(add_constants(a, -b, x.dtype), sub(u, v))
    if is_operation(x, "neg"):
        return neg(add(x.args[0], y))
    product = _common_factor(x, y, -1)
    return build("sub", x, y) if product is None else product


def _shift(c: float, y: Scalar) -> Scalar:
    """c + y for a constant c."""
    if is_constant(y):
        return c + y
    b, v = split_constant(y)
    c = add_constants(c, b, y.dtype)
    if c == 0:
        return v
    return build("sub", c, v.args[0]) if v.op == "neg" else build("add", c, v)


def _common_factor(x: Expression, y: Expression, sign: int) -> Scalar | None:
    """x + sign y with one multiplication fewer, or None: a z + b z = (a + b) z, c u + c v = c (u + v)."""
    (a, u), (b, v) = split_coefficient(x), split_coefficient(y)
    b = sign * b
    if u is v:
        return mul(add_constants(a, b, u.dtype), u)
    if not is_close(abs(a), abs(b), u.dtype) or u.dtype.kind != "f":
        return None
    sign = 1 if a * b > 0 else -1
    identity = _angle_sum(u, v, sign)
    if identity is not None:
        return mul(a, identity)
    if a in (1, -1):
        return None
    return mul(a, add(u, v) if sign > 0 else sub(u, v))


# --- products, quotients and powers -----------------------------------------------------------------------------------


def mul(x: Scalar, y: Scalar) -> Scalar:
    """x y, with sign and constant factor outermost; linearizes products of sines and cosines of one angle."""
    if is_constant(x):
        return x * y if is_constant(y) else _scale(x, y)
    if is_constant(y):
        return _scale(y, x)
    (a, u), (b, v) = split_coefficient(x), split_coefficient(y)
    identity = _double_angle(u, v)
    return _scale(a * b, build("mul", u, v)) if identity is None else mul(a * b, identity)


def _scale(c: float, y: Expression) -> Scalar:
    """c y for a constant c."""
    b, v = split_coefficient(y)
    c = c * b
    if is_close(abs(c), 1, y.dtype):
        c = math.copysign(1, c)
    if c == 0:
        return y.dtype.type(0).item()
    if c == 1:
        return v
    if c == -1:
        return neg(v)
    d, w = split_constant(v)
    if not is_number(d, 0):
        return _shift(c * d, mul(c, w))
    return build("mul", c, v) if c > 0 else neg(build("mul", -c, v))


def div(x: Scalar, y: Scalar) -> Scalar:
    """x / y; a product if y is a constant."""
    if not (_is_floating(x) or _is_floating(y)):
        return build("div", x, y)
    if is_constant(y):
        if is_constant(x):
            return fold("div", x, y, dtype=np.dtype(float))
        return _scale(1 / y, x) if y != 0 else build("div", x, y)
    b, v = split_coefficient(y)
    if is_constant(x):
        if x == 0:
            return x
        return mul(x / b, div(v.args[1], v.args[0])) if v.op == "div" else _scale(x / b, build("div", 1.0, v))
    a, u = split_coefficient(x)
    return a / b if u is v else _scale(a / b, build("div", u, v))


def _is_floating(x: Scalar) -> bool:
    return x.dtype.kind == "f" if isinstance(x, Expression) else isinstance(x, float)


def integer_pow(x: Scalar, y: int) -> Scalar:
    """x^y by repeated squaring."""
    if y == 0:
        return 1.0
    if y < 0:
        return div(1.0, integer_pow(x, -y))
    half = integer_pow(x, y // 2)
    square = mul(half, half) if y > 1 else 1
    return mul(square, x) if y % 2 else square


def power(x: Scalar, y: Scalar) -> Scalar:
    """x^y; a product if y is a small whole number."""
    if is_constant(y) and abs(y) <= 8 and y == int(y):
        return integer_pow(x, int(y))
    return build("pow", x, y)


# --- sines and cosines ------------------------------------------------------------------------------------------------


def sin(angle: Scalar) -> Scalar:
    """sin a; sin(-a) = -sin a."""
    if is_constant(angle):
        return fold("sin", angle, dtype=np.dtype(float))
    return neg(build("sin", neg(angle))) if _is_negative(angle) else build("sin", angle)


def cos(angle: Scalar) -> Scalar:
    """cos a; cos(-a) = cos a."""
    if is_constant(angle):
        return fold("cos", angle, dtype=np.dtype(float))
    return build("cos", neg(angle) if _is_negative(angle) else angle)


def _is_negative(x: Expression) -> bool:
    """Whether x is written as a negative multiple of something."""
    return x.op == "neg" or (x.op == "mul" and is_constant(x.args[0]) and x.args[0] < 0)


def _angle_sum(u: Expression, v: Expression, sign: int) -> Scalar | None:
    """cos a cos b -+ sin a sin b = cos(a +- b), sin a cos b +- cos a sin b = sin(a +- b), or None."""
    left, right = _sines_and_cosines(u), _sines_and_cosines(v)
    if left is None or right is None:
        return None
    ((first, a), (second, b)), ((third, c), (fourth, d)) = left, right
    if {a, b} != {c, d}:
        return None
    kinds = first + second, third + fourth
    if set(kinds) == {"coscos", "sinsin"}:
        if kinds[0] == "coscos":
            return cos(sub(a, b) if sign > 0 else add(a, b))
        return cos(sub(a, b)) if sign > 0 else neg(cos(add(a, b)))
    if set(kinds) <= {"sincos", "cossin"}:
        (sin_1, cos_1), (sin_2, cos_2) = (
            angles if kind == "sincos" else angles[::-1] for kind, angles in zip(kinds, ((a, b), (c, d)), strict=True)
        )
        if sin_1 is cos_2 and cos_1 is sin_2:
            return sin(add(sin_1, cos_1) if sign > 0 else sub(sin_1, cos_1))
    return None


def _sines_and_cosines(x: Expression):
    """((kind, angle), (kind, angle)) for a product of two sines or cosines, else None."""
    if x.op != "mul" or not all(is_operation(arg, "sin") or is_operation(arg, "cos") for arg in x.args):
        return None
    return tuple((arg.op, arg.args[0]) for arg in x.args)


def _double_angle(u: Expression, v: Expression) -> Scalar | None:
    """sin a cos a = sin(2a) / 2, sin^2 a = (1 - cos(2a)) / 2, cos^2 a = (1 + cos(2a)) / 2, or None."""
    if not {u.op, v.op} <= {"sin", "cos"} or u.args[0] is not v.args[0]:
        return None
    angle = add(u.args[0], u.args[0])
    if u.op != v.op:
        return mul(0.5, sin(angle))
    half = mul(0.5, cos(angle))
    return sub(0.5, half) if u.op == "sin" else add(0.5, half)
