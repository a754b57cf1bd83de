"""How a program of scalar equations is handed to XLA so that it runs fast.

XLA compiles a group of elementwise operations into one loop for every result that leaves the group, and computes what
two results share once in each of their loops. Left alone it makes of a whole physics step a few loops that repeat
nearly everything. So here it is decided which values are stored: those that would cost more to compute again than to
write and read. Every loop then computes one stored value from stored ones. The stored values are put into stages by
their depth; a stage is a call that XLA may not inline, so its loops neither merge with nor repeat those of another
stage. Under `vmap` a stored value is one contiguous vector of the batch.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax import lax

# Attaching metadata has no stable home in jax yet; without it stages still compute the same, slower, as XLA inlines
# them.
from jax.experimental.xla_metadata import set_xla_metadata

from envs.physics.expressions import Expression
from envs.physics.trigonometry import sincos

# What a value costs to compute, in additions.
COST = {"sin": 12, "cos": 12, "div": 4, "sqrt": 4, "rsqrt": 8, "pow": 20, "exp": 10, "log": 10, "tanh": 12, "atan2": 30}
# What it costs to write a value and read it again. Measured at 1,024 environments: a two-link arm is fastest at 16,
# and a fifth slower at 8 and 32; a seven-joint arm is equally fast from 0 to 11, and a fifth slower at 16.
STORING = 10
# A value that costs more is stored, however few use it. A loop inside a kernel may not be so large that XLA splits it
# between threads (`envs.physics.tiles`): one that joins two such values has less than a hundred additions, and XLA
# begins to split arrays of 128 numbers at about 150.
LARGEST = 48
# The equations of a kernel. The compiler takes more than twice as long for twice as many, and compiles two kernels on
# two cores at once; a seven-joint arm is a seventh slower in three kernels than in one.
KERNEL = 3000


@dataclass(frozen=True)
class Stage:
    """Expressions that are computed from stored values and stored; `equations` has what they need, operands first."""

    equations: list[Expression]
    inputs: list[Expression]
    outputs: list[Expression]
    run: Callable[..., list[jax.Array]]


def make_stages(outputs: Iterable[Expression]) -> list[Stage]:
    """The stages that compute the given expressions, in order."""
    wanted = list(outputs)
    equations = in_order(wanted)
    depth = _stored_depths(equations, {x.index for x in wanted})
    by_depth = defaultdict(list)
    for expression in equations:
        if expression.index in depth:
            by_depth[depth[expression.index]].append(expression)
    return [_make_stage(by_depth[level], depth) for level in sorted(by_depth)]


def in_order(outputs: Iterable[Expression]) -> list[Expression]:
    """Every expression that the outputs depend on, operands first, without the inputs of the program."""
    return _cone(outputs, lambda expression: expression.op == "input")[0]


def _cone(outputs: Iterable[Expression], is_given: Callable) -> tuple[list[Expression], list[Expression]]:
    """(computed, given): what the outputs need, operands first, down to the expressions that are given."""
    computed: dict[int, Expression] = {}
    given: dict[int, Expression] = {}
    stack = [x for x in outputs if x.op != "input"]
    while stack:
        expression = stack.pop()
        if expression.index in computed:
            continue
        computed[expression.index] = expression
        for arg in _operands(expression):
            if is_given(arg):
                given[arg.index] = arg
            else:
                stack.append(arg)
    return [computed[i] for i in sorted(computed)], [given[i] for i in sorted(given)]


def _operands(expression: Expression) -> list[Expression]:
    return [arg for arg in expression.args if isinstance(arg, Expression)]


def _stored_depths(equations: list[Expression], wanted: set[int]) -> dict[int, int]:
    """The stored expressions, with how many stored ones lie one behind the other below them."""
    uses = Counter(arg.index for expression in equations for arg in _operands(expression))
    stored: dict[int, int] = {}
    repeated: dict[int, frozenset[Expression]] = {}  # of those not stored: what a user computes with them
    depth: dict[int, int] = {}
    for expression in equations:
        below = [arg for arg in _operands(expression) if arg.op != "input"]
        here = frozenset({expression}).union(*(repeated[arg.index] for arg in below if arg.index not in stored))
        level = max((depth[arg.index] + (arg.index in stored) for arg in below), default=0)
        depth[expression.index] = level
        cost = sum(COST.get(part.op, 1) for part in here)
        if expression.index in wanted or (uses[expression.index] - 1) * cost > STORING or cost > LARGEST:
            stored[expression.index] = level
        else:
            repeated[expression.index] = here
    return stored


def _make_stage(outputs: list[Expression], stored: dict[int, int]) -> Stage:
    equations, inputs = _cone(outputs, lambda arg: arg.op == "input" or arg.index in stored)

    def compute(*values):
        return evaluate(equations, dict(zip((x.index for x in inputs), values, strict=True)), outputs)

    return Stage(equations, inputs, outputs, separately(compute))


def separately(function: Callable, **marks: str) -> Callable:
    """A function of arrays that XLA compiles by itself: it is called, never inlined into its surroundings.

    `marks` are further frontend attributes of the call.
    """
    compiled = jax.jit(function)

    def call(*values):
        with set_xla_metadata(inlineable="false", **marks):
            return compiled(*values)

    return call


def as_kernel(function: Callable) -> Callable:
    """A function that XLA's CPU compiler makes one kernel of, instead of one for every loop in it.

    XLA does so with the small loops it finds itself, by marking their call; the mark is set here by hand. The compiler
    relies on it that a marked call uses whatever it is given, also after simplifications, and ends the process where
    that is not so: hence a call inside the call, whose operands stay, and the barrier, which constants do not pass.
    """
    call = separately(separately(function), xla_cpu_small_call="true")

    def kernel(*arrays):
        return call(*lax.optimization_barrier(arrays))

    return kernel


def in_kernels(stages: list[Stage], outputs: Iterable[Expression]) -> list[Stage]:
    """Consecutive stages joined into kernels, so large that a program has few and so small that they compile fast."""
    groups: list[list[Stage]] = []
    room = 0
    for stage in stages:
        if room < len(stage.equations):
            groups.append([])
            room = KERNEL
        groups[-1].append(stage)
        room -= len(stage.equations)
    used = {x.index for x in outputs}
    kernels = []
    for group in reversed(groups):
        kernel = _join(group, used)
        used |= {x.index for x in kernel.inputs}
        kernels.append(kernel)
    return kernels[::-1]


def _join(group: list[Stage], used: set[int]) -> Stage:
    """Stages as one, that stores in the end what is used outside of it."""
    computed = {x.index: x for stage in group for x in stage.outputs}
    given = {x.index: x for stage in group for x in stage.inputs if x.index not in computed}
    outputs = [x for index, x in computed.items() if index in used]

    def compute(*values):
        known = dict(zip(given, values, strict=True))
        run(group, known)
        return [known[x.index] for x in outputs]

    equations = [x for stage in group for x in stage.equations]
    return Stage(equations, list(given.values()), outputs, as_kernel(compute))


def run(stages: list[Stage], values: dict[int, Any]) -> None:
    """Adds the outputs of all stages to the values by index."""
    for stage in stages:
        results = stage.run(*(values[x.index] for x in stage.inputs))
        values.update(zip((x.index for x in stage.outputs), results, strict=True))


# --- writing equations ------------------------------------------------------------------------------------------------

LAX = {
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "xor": lax.bitwise_xor,
    "not": lax.bitwise_not,
    "round": lambda x, rounding_method: lax.round(x, lax.RoundingMethod(rounding_method)),
}


def evaluate(equations: list[Expression], values: dict[int, Any], outputs: list[Expression]) -> list:
    """The outputs' values by jax operations; `values` has those of the expressions that are given."""
    pairs: dict[int, tuple] = {}
    for expression in equations:
        if expression.op in ("sin", "cos"):
            (angle,) = expression.args
            if angle.index not in pairs:
                pairs[angle.index] = sincos(values[angle.index])
            values[expression.index] = pairs[angle.index][expression.op == "cos"]
        else:
            function = LAX.get(expression.op) or getattr(lax, expression.op)
            operands = [values[arg.index] if isinstance(arg, Expression) else arg for arg in _typed(expression)]
            values[expression.index] = function(*operands, **dict(expression.params))
    return [values[x.index] for x in outputs]


def _typed(expression: Expression) -> list:
    """The operands, with the constants among them in the dtype of the others."""
    dtype = next((arg.dtype for arg in _operands(expression) if arg.dtype.kind != "b"), expression.dtype)
    return [
        arg if isinstance(arg, Expression) else np.asarray(arg, bool if isinstance(arg, bool) else dtype)
        for arg in expression.args
    ]
