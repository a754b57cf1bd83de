"""Evaluates programs of scalar equations by NumPy, without compiling anything."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from envs.physics.arrays import as_objects
from envs.physics.expressions import Expression
from envs.physics.folding import NUMPY
from envs.physics.interpreter import Program
from envs.physics.loops import Loop, find_loop, is_result
from envs.physics.stages import sort_equations


def evaluate(program: Program, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The results of a program for N environments: arrays `[N, ...]` -> arrays `[N, ...]`.

    They have the precision of the program. An environment's result does not depend on the others. It takes some
    microseconds for each equation, and with loops for each round.
    """
    values: dict[int, Any] = {}
    for symbols, array in zip(program.inputs, arguments, strict=True):
        for place in np.ndindex(symbols.shape):
            values[symbols[place].index] = np.asarray(array[(slice(None), *place)], symbols[place].dtype)
    size = len(arguments[0])
    with np.errstate(all="ignore"):
        _run(program.equations(), values, size)
    return [
        np.stack([np.broadcast_to(_read(values, x), size) for x in as_objects(output).flat], axis=-1).reshape(
            size, *output.shape
        )
        if output.size
        else np.zeros((size, *output.shape))
        for output in program.outputs
    ]


def _read(values: dict[int, Any], x: Any) -> Any:
    return values[x.index] if isinstance(x, Expression) else x


def _run(equations: Iterable[Expression], values: dict[int, Any], size: int) -> None:
    """Adds the values of the equations, operands first."""
    loops: dict[Loop, list[np.ndarray]] = {}
    for x in equations:
        operands = [_read(values, arg) for arg in x.args]
        if not is_result(x):
            values[x.index] = np.asarray(NUMPY[x.op](*operands, **dict(x.params)), x.dtype)
            continue
        loop, place = find_loop(x)
        if loop not in loops:
            loops[loop] = _repeat(loop, operands, size)
        values[x.index] = loops[loop][place]


def _repeat(loop: Loop, operands: list, size: int) -> list[np.ndarray]:
    """The carried values after the last round of each environment."""
    number = len(loop.carried)
    carry = [np.broadcast_to(x, size) for x in operands[:number]]
    captured = dict(zip((x.index for x in loop.captured), operands[number:], strict=True))
    equations = sort_equations(loop.outputs())
    while carry[0].any():
        values = captured | dict(zip((x.index for x in loop.carried), carry, strict=True))
        _run(equations, values, size)
        after = [_read(values, x) for x in loop.following]
        carry = [np.where(carry[0], new, old) for new, old in zip(after, carry, strict=True)]
    return carry
