"""Scalar expressions: what a number is while a program is being turned into scalar equations.

An `Expression` is one scalar operation on other expressions and on constants (Python numbers). A `Graph` has each of
them once: the same operation on the same operands is the expression that is there already. Here an expression is taken
as it is written; `envs.physics.primitives.apply` simplifies it first.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeGuard, Union

import numpy as np

if TYPE_CHECKING:
    from typing_extensions import TypeIs  # in `typing` from Python 3.13 on

Constant = float | int | bool
Scalar = Union["Expression", float, int, bool]

COMMUTATIVE = frozenset({"add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"})


class Expression:
    """One scalar operation of a `Graph`.

    Attributes:
      op: the name of a jax primitive, or "input".
      args: its operands.
      params: the primitive's parameters as a hashable tuple of pairs.
      dtype: of the result.
      index: the number of the expression in its graph; operands have smaller numbers.
    """

    __slots__ = ("args", "dtype", "graph", "index", "op", "params")

    def __init__(self, graph: Graph, op: str, args: tuple, params: tuple, dtype: np.dtype):
        self.graph, self.op, self.args, self.params, self.dtype = graph, op, args, params, dtype
        self.index = graph.size
        graph.size += 1

    def __repr__(self):
        return f"{self.op}[{self.index}]"


class Graph:
    """The expressions of one program, each of them once."""

    def __init__(self):
        self.size = 0
        self._known: dict[tuple, Expression] = {}

    def input(self, dtype: np.dtype) -> Expression:
        """A new input of the program."""
        return Expression(self, "input", (), (), np.dtype(dtype))

    def expression(self, op: str, args: tuple, params: tuple, dtype: np.dtype) -> Expression:
        """The expression as written, without simplification."""
        if op in COMMUTATIVE and _order(args[0]) > _order(args[1]):
            args = (args[1], args[0])
        key = (op, tuple(map(identity, args)), params, dtype)
        found = self._known.get(key)
        if found is None:
            found = self._known[key] = Expression(self, op, args, params, dtype)
        return found


def build(op: str, *args: Scalar, dtype: np.dtype | None = None, params: tuple = ()) -> Expression:
    """The expression as written, in the graph of its operands; of the first one's dtype where none is given."""
    some = next(arg for arg in args if isinstance(arg, Expression))
    return some.graph.expression(op, args, params, some.dtype if dtype is None else dtype)


def identity(x: Scalar):
    """What tells two operands apart: 0.0 and -0.0, and 1, 1.0 and True, are different constants."""
    if isinstance(x, Expression):
        return x.index
    return type(x), x, math.copysign(1.0, x)


def _order(x: Scalar) -> int:
    """Constants first, then in the order of making."""
    return x.index if isinstance(x, Expression) else -1


def is_constant(x: Scalar) -> TypeIs[Constant]:
    """Whether x is a number."""
    return not isinstance(x, Expression)


def is_number(x: Scalar, value: float) -> TypeGuard[Constant]:
    """Whether x is this number."""
    return is_constant(x) and x == value


def is_operation(x: Scalar, op: str) -> TypeGuard[Expression]:
    """Whether x is an expression of this operation."""
    return isinstance(x, Expression) and x.op == op
