"""Loops whose number of rounds depends on the data.

A round is a program of its own: a `Loop` has its own graph, with inputs for the values that a round changes and for
those that it only reads. In the graph around it, the values after the last round are expressions of the operation
"loop", one for each value, all with the same operands: first the values before the first round, then those that are
only read.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from envs.physics.expressions import Expression, Graph, Scalar, build, is_constant
from envs.physics.primitives import logical_and

Advance = Callable[[Callable[[Scalar], Scalar], list[Scalar]], list[Scalar]]


@dataclass(frozen=True, eq=False)
class Loop:
    """Rounds that are repeated while the first of the carried values is true.

    Attributes:
      carried: inputs for the values that a round changes; the first one says whether there is another round.
      captured: inputs for the values that the rounds only read.
      following: for each of `carried`, its value after the round.
    """

    carried: tuple[Expression, ...]
    captured: tuple[Expression, ...]
    following: tuple[Scalar, ...]

    def outputs(self) -> list[Expression]:
        """The values after a round, without the constants."""
        return [x for x in self.following if isinstance(x, Expression)]


def is_result(x: Scalar) -> TypeGuard[Expression]:
    """Whether x is a result of a loop."""
    return isinstance(x, Expression) and x.op == "loop"


def make_result(loop: Loop, place: int, operands: Sequence[Scalar]) -> Expression:
    """The carried value in this place after the last round."""
    params = (("loop", loop), ("place", place))
    return build("loop", *operands, dtype=loop.carried[place].dtype, params=params)


def find_loop(result: Expression) -> tuple[Loop, int]:
    """(loop, place): the loop that this is a result of, and its place among the carried values."""
    params = dict(result.params)
    return params["loop"], params["place"]


# --- tracing ----------------------------------------------------------------------------------------------------------


def trace_loop(advance: Advance, initial: list[Scalar], dtypes: list[np.dtype], wanted: list[bool]) -> list[Scalar]:
    """The values after the last round; of those that nobody needs, the values before the first one.

    Args:
      advance: the values after a round, from a function `capture`, which must be applied to every value from outside
        the loop, and from the values before the round.
      initial: values before the first round; the first one says whether there is a round.
      dtypes: their dtypes.
      wanted: for each of them, whether the last value is used outside.
    """
    initial = [restrict(initial[0]), *initial[1:]]
    varies = [not is_constant(x) for x in initial]
    traced = _Round(advance, initial, dtypes, varies)
    while traced.varies != varies:
        varies = traced.varies
        traced = _Round(advance, initial, dtypes, varies)
    return _finish(traced, initial, wanted)


def restrict(condition: Scalar) -> Scalar:
    """The condition, or false where the results of what is traced now are not used.

    Under `vmap` an environment takes part in all rounds of the others. So a loop inside a loop would go on for one that
    is done with the outer loop, and whose values may be such that the inner one takes longest.
    """
    if is_constant(condition):
        return condition
    return functools.reduce(logical_and, condition.graph.conditions, condition)


class _Round:
    """One round, traced with inputs for the values that vary; the others are taken to be constants.

    Attributes:
      before, after: the values before and after the round.
      varies: which values vary, now that the round is known; those that turn out to be changed are added. So a value
        that is constant at first and in each round stays one, for example a structural zero.
      outside: for each captured input, by its index, the value outside.
    """

    def __init__(self, advance: Advance, initial: list[Scalar], dtypes: list[np.dtype], varies: list[bool]):
        self._graph = Graph()
        self._inside: dict[int, Expression] = {}
        self.outside: dict[int, Scalar] = {}
        self.before = [
            self._graph.input(dtype) if new else x for x, dtype, new in zip(initial, dtypes, varies, strict=True)
        ]
        with self._graph.suppose(self.before[0]):
            self.after = advance(self._capture, list(self.before))
        self.varies = [
            known or not (is_constant(new) and new == old)
            for known, old, new in zip(varies, self.before, self.after, strict=True)
        ]

    def _capture(self, x: Scalar) -> Scalar:
        """The input for a value from outside; the same one for the same value."""
        if is_constant(x):
            return x
        if x.index not in self._inside:
            inside = self._inside[x.index] = self._graph.input(x.dtype)
            self.outside[inside.index] = x
        return self._inside[x.index]


def _finish(traced: _Round, initial: list[Scalar], wanted: list[bool]) -> list[Scalar]:
    """The results of the loop with this round."""
    inputs = {i: x for i, x in enumerate(traced.before) if isinstance(x, Expression)}
    changed = {x.index: i for i, x in inputs.items() if i == 0 or traced.after[i] is not x}
    outside = traced.outside | {x.index: initial[i] for i, x in inputs.items() if x.index not in changed}
    needed, read = _find_needed(traced.after, changed, [0, *(i for i in changed.values() if wanted[i])])
    captured = [x for x in read if x.index in outside]
    loop = Loop(
        carried=tuple(inputs[i] for i in needed),
        captured=tuple(captured),
        following=tuple(traced.after[i] for i in needed),
    )
    operands = [*(initial[i] for i in needed), *(outside[x.index] for x in captured)]
    results = {i: make_result(loop, place, operands) for place, i in enumerate(needed)}
    return [results.get(i, x) for i, x in enumerate(initial)]


def _find_needed(after: list[Scalar], changed: dict[int, int], roots: list[int]) -> tuple[list[int], list[Expression]]:
    """(needed, read): the values that those in the places `roots` depend on, round by round, and the inputs read."""
    needed, seen = set(roots), {}
    stack = [after[i] for i in needed]
    while stack:
        x = stack.pop()
        if is_constant(x) or x.index in seen:
            continue
        seen[x.index] = x
        stack += x.args
        place = changed.get(x.index)
        if place is not None and place not in needed:
            needed.add(place)
            stack.append(after[place])
    return sorted(needed), [seen[i] for i in sorted(seen) if seen[i].op == "input"]
