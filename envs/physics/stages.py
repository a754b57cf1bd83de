"""Divides a program of scalar equations into stages so that XLA runs it fast.

XLA compiles a group of elementwise operations into one loop for every result that leaves the group, and repeats shared
computations in each of these loops. By itself it would turn a whole physics step into a few loops that repeat nearly
everything. So the values to store are chosen here: those that cost more to compute again than to write and read. Every
loop then computes one stored value from others. Stored values are grouped into stages by their depth. A stage is a call
that XLA may not inline, so its loops neither merge with nor repeat those of other stages. Under `vmap` a stored value
is one contiguous vector of the batch.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

# Jax has no stable API for metadata yet. Without it stages compute the same but slower, as XLA inlines them.
from jax.experimental.xla_metadata import set_xla_metadata

from envs.physics.expressions import Expression, Scalar, build
from envs.physics.loops import Loop, find_loop, is_result
from envs.physics.trigonometry import sincos

# Cost of computing a value, in additions.
COST = {
    "sin": 12,
    "cos": 12,
    "div": 4,
    "sqrt": 4,
    "rsqrt": 8,
    "pow": 20,
    "exp": 10,
    "log": 10,
    "tanh": 12,
    "atan2": 30,
    "stop_gradient": 0,
}
# Cost of writing a value and reading it again. Measured with 1,024 environments: a two-link arm is fastest at 16, and a
# fifth slower at 8 and 32; a seven-joint arm is equally fast from 0 to 11, and a fifth slower at 16.
STORING = 10
# A value that costs more is always stored. A loop inside a kernel must not be so large that XLA splits it between
# threads (`envs.physics.tiles`): a loop that joins two such values has less than a hundred additions, and XLA begins to
# split arrays of 128 numbers at about 150.
LARGEST = 48
# These are stored even if they are used once. With 1,024 environments XLA splits a loop of a sine and a few other
# operations between two threads, which takes three times as long as two loops on one thread.
STORED = ("sin", "cos")
MOST_ROUNDS = 2**30  # of a loop: more than there ever are


@dataclass(frozen=True)
class Stage:
    """Expressions that are computed from stored values and then stored, by `equations`, operands first.

    The results of a loop are a stage of their own; `body` has the stages of one round.
    """

    equations: list[Expression]
    inputs: list[Expression]
    outputs: list[Expression]
    run: Callable[..., list[jax.Array]]
    body: Sequence[Stage] = ()

    @property
    def size(self) -> int:
        """The number of equations, with those of a loop's round."""
        return len(self.equations) + sum(stage.size for stage in self.body)

    @property
    def num_stored(self) -> int:
        """The number of stored values, with those of a loop's round."""
        return len(self.outputs) + sum(stage.num_stored for stage in self.body)


def make_stages(outputs: Iterable[Expression]) -> list[Stage]:
    """The stages that compute the given expressions, in order."""
    wanted = list(outputs)
    equations = sort_equations(wanted)
    wanted += [arg for expression in equations if is_result(expression) for arg in _operands(expression)]
    depth = _choose_stored(equations, {x.index for x in wanted})
    groups = defaultdict(list)
    for expression in equations:
        if expression.index in depth:
            loop = find_loop(expression)[0] if is_result(expression) else None
            groups[depth[expression.index], loop].append(expression)
    return [
        _make_stage(groups[level, loop], depth)
        if loop is None
        else make_loop(groups[level, loop], make_stages(select_following(loop)))
        for level, loop in sorted(groups, key=lambda key: key[0])
    ]


def sort_equations(outputs: Iterable[Expression]) -> list[Expression]:
    """All expressions that the outputs depend on, operands first, without the inputs of the program."""
    return _collect_operands(outputs, lambda expression: expression.op == "input")[0]


def find_loops(equations: Iterable[Expression]) -> list[Loop]:
    """The loops among the equations and inside these loops, innermost first."""
    loops = dict.fromkeys(find_loop(x)[0] for x in equations if is_result(x))
    found = [inner for loop in loops for inner in (*find_loops(sort_equations(loop.outputs())), loop)]
    return list(dict.fromkeys(found))


def count_equations(equations: Iterable[Expression]) -> int:
    """The number of equations, with those of a loop's round counted once."""
    equations = list(equations)
    return len(equations) + sum(len(sort_equations(loop.outputs())) for loop in find_loops(equations))


def _collect_operands(outputs: Iterable[Expression], is_given: Callable) -> tuple[list[Expression], list[Expression]]:
    """(computed, given): the expressions that the outputs need, operands first, down to the given ones."""
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


def _choose_stored(equations: list[Expression], wanted: set[int]) -> dict[int, int]:
    """The expressions to store, each with its depth: the length of the longest chain of stored ones below it."""
    uses = Counter(arg.index for expression in equations for arg in _operands(expression))
    stored: dict[int, int] = {}
    repeated: dict[int, frozenset[Expression]] = {}  # for each one not stored: all that its users compute again
    depth: dict[int, int] = {}
    for expression in equations:
        operands = [arg for arg in _operands(expression) if arg.op != "input"]
        computed = frozenset({expression}).union(*(repeated[arg.index] for arg in operands if arg.index not in stored))
        level = max((depth[arg.index] + (arg.index in stored) for arg in operands), default=0)
        depth[expression.index] = level
        cost = sum(COST.get(part.op, 1) for part in computed)
        is_costly = (uses[expression.index] - 1) * cost > STORING or cost > LARGEST
        is_always_stored = expression.index in wanted or expression.op in STORED or is_result(expression)
        if is_costly or is_always_stored:
            stored[expression.index] = level
        else:
            repeated[expression.index] = computed
    return stored


def _make_stage(outputs: list[Expression], stored: dict[int, int]) -> Stage:
    equations, inputs = _collect_operands(outputs, lambda arg: arg.op == "input" or arg.index in stored)

    def compute(*values):
        return evaluate(equations, dict(zip((x.index for x in inputs), values, strict=True)), outputs)

    return Stage(equations, inputs, outputs, compile_separately(compute))


def select_following(loop: Loop) -> list[Expression]:
    """The values after a round; an environment that is done keeps its values while others of its batch go on."""
    goes_on = loop.carried[0]
    return [
        build("select_n", goes_on, before, after) for before, after in zip(loop.carried, loop.following, strict=True)
    ]


def make_loop(results: list[Expression], body: list[Stage]) -> Stage:
    """A stage of results of one loop, with these stages of its rounds."""
    loop, _ = find_loop(results[0])
    operands = results[0].args
    inputs = list({x.index: x for x in operands if isinstance(x, Expression)}.values())
    places = [find_loop(x)[1] for x in results]

    def compute(*values):
        known = dict(zip((x.index for x in inputs), values, strict=True))
        batch = np.broadcast_shapes(*(x.shape for x in values))
        carry = _repeat(loop, body, read(known, operands, [x.dtype for x in loop.carried + loop.captured], batch))
        return [carry[place] for place in places]

    return Stage(results, inputs, results, compile_separately(compute), body)


def _repeat(loop: Loop, body: list[Stage], operands: list[jax.Array]) -> tuple[jax.Array, ...]:
    """The carried values after the last round of all environments.

    Whether there is another round is itself carried, as under `vmap` jax computes the condition twice in a round.
    """
    num_carried = len(loop.carried)
    captured = dict(zip((x.index for x in loop.captured), operands[num_carried:], strict=True))
    dtypes = [x.dtype for x in loop.carried]
    following, batch = select_following(loop), operands[0].shape

    def advance(state):
        count, *carry = state
        values = captured | dict(zip((x.index for x in loop.carried), carry, strict=True))
        run(body, values)
        return count + 1, *read(values, following, dtypes, batch)

    # XLA's CPU compiler (jaxlib 0.10.1) takes a loop whose body is nothing but one call of the carried values, in their
    # order, for one that changes none of them, and it never ends. The count is not part of the call.
    state = lax.while_loop(
        lambda state: jnp.any(state[1]) & (state[0] < MOST_ROUNDS), advance, (np.int32(0), *operands[:num_carried])
    )
    return state[1:]


def read(
    values: dict[int, Any], scalars: Iterable[Scalar], dtypes: Iterable[np.dtype], batch: tuple[int, ...]
) -> list[jax.Array]:
    """The values of expressions and constants, of the shape of the batch."""
    return [
        values[x.index] if isinstance(x, Expression) else jnp.full(batch, x, dtype)
        for x, dtype in zip(scalars, dtypes, strict=True)
    ]


def compile_separately(function: Callable, **attributes: str) -> Callable:
    """Makes XLA compile a function of arrays separately: it is called and never inlined.

    `attributes` are further frontend attributes of the call.
    """
    compiled = jax.jit(function)

    def call(*values):
        with set_xla_metadata(inlineable="false", **attributes):
            return compiled(*values)

    return call


def run(stages: list[Stage], values: dict[int, Any]) -> None:
    """Adds the outputs of all stages to `values`, by index."""
    for stage in stages:
        results = stage.run(*(values[x.index] for x in stage.inputs))
        values.update(zip((x.index for x in stage.outputs), results, strict=True))


# --- evaluating equations ---------------------------------------------------------------------------------------------

LAX = {
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "xor": lax.bitwise_xor,
    "not": lax.bitwise_not,
    "round": lambda x, rounding_method: lax.round(x, lax.RoundingMethod(rounding_method)),
}


def evaluate(equations: list[Expression], values: dict[int, Any], outputs: list[Expression]) -> list:
    """Computes the outputs by jax operations; `values` has the values of the given expressions."""
    pairs: dict[int, tuple] = {}
    for expression in equations:
        if expression.op in ("sin", "cos"):
            (angle,) = expression.args
            if angle.index not in pairs:
                pairs[angle.index] = sincos(values[angle.index])
            values[expression.index] = pairs[angle.index][expression.op == "cos"]
        else:
            function = LAX.get(expression.op) or getattr(lax, expression.op)
            values[expression.index] = function(*_read_operands(expression, values), **dict(expression.params))
    return [values[x.index] for x in outputs]


def _read_operands(expression: Expression, values: dict[int, Any]) -> list:
    """The operands, with constants converted to the dtype of the others, and as `jax.lax` broadcasts them."""
    arguments = _operands(expression)
    dtype = next((arg.dtype for arg in arguments if arg.dtype.kind != "b"), expression.dtype)
    batch = values[arguments[0].index].shape
    shape = {"select_n": batch, "clamp": ()}.get(expression.op, (1,) * len(batch))
    return [
        values[arg.index]
        if isinstance(arg, Expression)
        else np.full(shape, arg, bool if isinstance(arg, bool) else dtype)
        for arg in expression.args
    ]
