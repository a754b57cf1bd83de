"""Scalar expressions, which stand for numbers while a program is turned into scalar equations.

An `Expression` is one scalar operation on other expressions and on constants (Python numbers). A `Graph` holds each
expression once: the same operation on the same operands returns the existing expression. Nothing is simplified here;
`envs.physics.primitives.apply` does that.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
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
      op: name of a jax primitive, or "input".
      args: operands.
      params: parameters of the primitive, as a hashable tuple of pairs.
      dtype: dtype of the result.
      index: number of the expression in its graph; operands have smaller numbers.
    """

    __slots__ = ("args", "dtype", "graph", "index", "op", "params")

    def __init__(self, graph: Graph, op: str, args: tuple, params: tuple, dtype: np.dtype):
        self.graph, self.op, self.args, self.params, self.dtype = graph, op, args, params, dtype
        self.index = graph.size
        graph.size += 1

    def __repr__(self):
        return f"{self.op}[{self.index}]"


class Graph:
    """The expressions of one program, without duplicates.

    Attributes:
      conditions: the results of what is traced now are used only if all of these are true.
    """

    def __init__(self):
        self.size = 0
        self.conditions: list[Scalar] = []
        self._known: dict[tuple, Expression] = {}

    def input(self, dtype: np.dtype) -> Expression:
        """A new input of the program."""
        return Expression(self, "input", (), (), np.dtype(dtype))

    @contextlib.contextmanager
    def suppose(self, condition: Scalar) -> Iterator[None]:
        """Inside this context, what is traced is used only if the condition is true."""
        self.conditions.append(condition)
        try:
            yield
        finally:
            self.conditions.pop()

    def expression(self, op: str, args: tuple, params: tuple, dtype: np.dtype) -> Expression:
        """The expression, without simplification."""
        if op in COMMUTATIVE and _order(args[0]) > _order(args[1]):
            args = (args[1], args[0])
        key = (op, tuple(map(identity, args)), params, dtype)
        found = self._known.get(key)
        if found is None:
            found = self._known[key] = Expression(self, op, args, params, dtype)
        return found


def build(op: str, *args: Scalar, dtype: np.dtype | None = None, params: tuple = ()) -> Expression:
    """The unsimplified expression, in the graph of its operands; by default with the first one's dtype."""
    operand = next(arg for arg in args if isinstance(arg, Expression))
    return operand.graph.expression(op, args, params, operand.dtype if dtype is None else dtype)


def identity(x: Scalar):
    """A key that identifies an operand; 0.0 and -0.0, and 1, 1.0 and True, are different constants."""
    if isinstance(x, Expression):
        return x.index
    return type(x), x, math.copysign(1.0, x)


def _order(x: Scalar) -> int:
    """Sort key: constants first, then expressions in order of creation."""
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
