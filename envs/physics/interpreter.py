"""Turns a function of small arrays into scalar equations.

`scalarize(fn, *example_args)` traces `fn` to a jaxpr and interprets it once, with every array replaced by its
elements: a number where the element is known, an `Expression` where it depends on the arguments. Slicing, gathering,
padding and stacking then cost nothing, products with 0 vanish, small dot products, factorisations and fixed-length
loops are written out, and unused results are dropped. Loops that run as long as the data say stay loops, of scalar
equations (`envs.physics.loops`). XLA gets the rest as scalar operations, which under `vmap` are
operations on contiguous vectors of the batch.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.arrays import as_objects, choose_array, is_numeric, pack, promote, simplify_dtype
from envs.physics.expressions import Expression, Graph
from envs.physics.kernels import join_into_kernels
from envs.physics.loops import trace_loop
from envs.physics.primitives import UnsupportedPrimitiveError, choose
from envs.physics.rules import RULES
from envs.physics.stages import (
    Stage,
    compile_separately,
    count_equations,
    make_stages,
    read,
    run,
    sort_equations,
)


def scalarize(fn: Callable, *example_args: Any) -> Callable:
    """Turns a function into the same function as scalar equations.

    Args:
      fn: a pure function of pytrees of arrays that jax can trace.
      example_args: arguments (arrays or `jax.ShapeDtypeStruct`s) with the shapes and dtypes of later arguments.

    Returns:
      A function of the same arguments with the same result up to rounding, which can be jitted, batched and
      differentiated. Its attribute `program` is the `Program`.

    Raises:
      UnsupportedPrimitiveError: `fn` has no scalar form, for example because it sorts more elements than a network is
        made for; the message names the primitive.
    """
    program = trace(fn, *example_args)

    def scalarized(*args):
        leaves, structure = jax.tree.flatten(args)
        if structure != program.input_structure:
            raise TypeError(f"expected arguments {program.input_structure}, got {structure}")
        elements = program.run(program.split(leaves))
        return jax.tree.unflatten(program.output_structure, program.join(elements))

    scalarized.program = program
    return scalarized


class Program:
    """The scalar equations of a function, with its inputs and outputs; made by `trace`.

    A call consists of `split`, `run` and `join`, so that a loop can call `run` alone and carry only the elements.

    Attributes:
      inputs: an array of input expressions for each leaf of the arguments.
      outputs: an array of expressions and constants for each leaf of the result.
      input_structure, output_structure: their pytree structures.
    """

    def __init__(self, inputs, outputs, output_dtypes, input_structure, output_structure):
        self.inputs, self.outputs, self.output_dtypes = inputs, outputs, output_dtypes
        self.input_structure, self.output_structure = input_structure, output_structure
        self._results = _split_elements(outputs)
        self.stages = make_stages(self._output_expressions())
        self._split = compile_separately(self._list_elements)

    @property
    def results(self) -> list[jax.ShapeDtypeStruct]:
        """Shapes and dtypes of the result's leaves."""
        return [
            jax.ShapeDtypeStruct(array.shape, dtype)
            for array, dtype in zip(self.outputs, self.output_dtypes, strict=True)
        ]

    def __len__(self):
        """The number of scalar equations, with those of a loop's round counted once."""
        return count_equations(self.equations())

    def equations(self) -> list[Expression]:
        """The scalar equations, operands first, without those inside loops."""
        return sort_equations(self._output_expressions())

    def kernels(self) -> list[Stage]:
        """The stages joined into a few large ones, each of them one kernel on a CPU."""
        return join_into_kernels(self.stages, self._output_expressions())

    def _output_expressions(self) -> list[Expression]:
        return [x for x in self._results if isinstance(x, Expression)]

    def split(self, leaves: Sequence) -> list[jax.Array]:
        """The elements of the leaves, in order; where these have a batch axis in front, vectors of the batch."""
        return self._split(*leaves)

    def _list_elements(self, *leaves):
        pairs = zip(self.inputs, leaves, strict=True)
        return [leaf[(..., *place)] for symbols, leaf in pairs for place in np.ndindex(*symbols.shape)]

    def run(self, elements: list[jax.Array], stages: list[Stage] | None = None) -> list[jax.Array]:
        """The elements of the result's leaves, computed by the program's stages or by those given."""
        values = dict(zip((x.index for array in self.inputs for x in array.flat), elements, strict=True))
        run(self.stages if stages is None else stages, values)
        dtypes = [dtype for array, dtype in zip(self.outputs, self.output_dtypes, strict=True) for _ in array.flat]
        return read(values, self._results, dtypes, elements[0].shape if elements else ())

    def join(self, elements: Sequence[jax.Array]) -> list[jax.Array]:
        """The result's leaves from their elements."""
        leaves, begin = [], 0
        batch = elements[0].shape if elements else ()
        for array, dtype in zip(self.outputs, self.output_dtypes, strict=True):
            part = elements[begin : begin + array.size]
            begin += array.size
            leaves.append(
                jnp.stack(part, axis=-1).reshape(*batch, *array.shape)
                if part
                else jnp.zeros((*batch, *array.shape), dtype)
            )
        return leaves


@contextlib.contextmanager
def _pause_collection() -> Iterator[None]:
    """No garbage is collected: a trace makes objects that stay, over which the collector would go again and again."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@_pause_collection()
def trace(fn: Callable, *example_args: Any) -> Program:
    """Traces a function to its scalar equations."""
    closed, shape = jax.make_jaxpr(fn, return_shape=True)(*example_args)
    graph = Graph()
    inputs = [_input_array(graph, aval) for aval in closed.in_avals]
    outputs = evaluate(closed.jaxpr, closed.consts, inputs)
    return Program(
        inputs,
        outputs,
        [np.dtype(aval.dtype) for aval in closed.out_avals],
        jax.tree.structure(example_args),
        jax.tree.structure(shape),
    )


def _input_array(graph: Graph, aval) -> np.ndarray:
    return pack([graph.input(aval.dtype) for _ in range(int(np.prod(aval.shape, dtype=int)))], aval.shape)


def evaluate(jaxpr, consts, args, wanted: list[bool] | None = None) -> list:
    """The results of a jaxpr, with None for those that are not wanted; interprets only the equations they need."""
    outvars = [var for i, var in enumerate(jaxpr.outvars) if wanted is None or wanted[i]]
    values = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))
    for equation, wanted_here in _find_needed(jaxpr, outvars):
        operands = [_read(values, var) for var in equation.invars]
        results = interpret(equation, operands, wanted_here)
        values.update((var, value) for var, value in zip(equation.outvars, results, strict=True) if value is not None)
    return [_read(values, var) if wanted is None or wanted[i] else None for i, var in enumerate(jaxpr.outvars)]


def _find_needed(jaxpr, outvars) -> list:
    """The equations that the variables depend on, and for each the results that are used."""
    used = {var for var in outvars if not _is_literal(var)}
    needed = []
    for equation in reversed(jaxpr.eqns):
        wanted = [var in used for var in equation.outvars]
        if any(wanted):
            needed.append((equation, wanted))
            used.update(var for var in equation.invars if not _is_literal(var))
    return needed[::-1]


def _is_literal(var) -> bool:
    return hasattr(var, "val")


def _read(values, var):
    return np.asarray(var.val, var.aval.dtype) if _is_literal(var) else values[var]


def interpret(equation, operands: list, wanted: list[bool]) -> list:
    """The results of one equation."""
    name, params = equation.primitive.name, equation.params
    if name in CONTROL:
        return CONTROL[name](operands, wanted, **params)
    if name not in RULES:
        raise UnsupportedPrimitiveError(f"{name}: no scalar rule")
    results = RULES[name](equation.outvars[0].aval, *operands, **params)
    results = results if isinstance(results, tuple) else (results,)
    return [simplify_dtype(result, var.aval.dtype) for result, var in zip(results, equation.outvars, strict=True)]


# --- primitives that contain programs ---------------------------------------------------------------------------------


def _call(operands, wanted, *, jaxpr=None, call_jaxpr=None, **_):
    closed = jaxpr if jaxpr is not None else call_jaxpr
    inner = getattr(closed, "jaxpr", closed)
    return evaluate(inner, getattr(closed, "consts", ()), operands, wanted)


def _call_high(operands, wanted, *, _prim):
    """A primitive that jax, from 0.12 on, does not expand in its jaxprs, and that can expand itself."""
    structure, avals = _prim.in_tree, _prim.in_avals_flat
    closed = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(_prim.expand(*structure.unflatten(leaves))))(*avals)
    return evaluate(closed.jaxpr, closed.consts, operands, wanted)


def _scan(operands, wanted, *, jaxpr, length, reverse, **groups):
    consts, carry, xs = _scan_operands(operands, **groups)
    num_carry = len(carry)
    rows = []
    for i in reversed(range(length)) if reverse else range(length):
        results = evaluate(jaxpr.jaxpr, jaxpr.consts, [*consts, *carry, *(x[i, ...] for x in xs)])
        carry = results[:num_carry]
        rows.append(results[num_carry:])
    rows = rows[::-1] if reverse else rows
    stacked = [np.stack(promote(*column)) for column in zip(*rows, strict=True)] or [
        np.zeros((0, *var.aval.shape), var.aval.dtype) for var in jaxpr.jaxpr.outvars[num_carry:]
    ]
    return [*carry, *stacked]


def _scan_operands(operands, *, num_consts=0, num_carry=0, ft_in=None, **_):
    """(consts, carry, xs), split by their numbers, or from jax 0.12 on by a tree."""
    if ft_in is not None:
        return map(list, ft_in.update(operands).unpack())
    return operands[:num_consts], operands[num_consts : num_consts + num_carry], operands[num_consts + num_carry :]


def _cond(operands, wanted, *, branches, **_):
    """The branch taken; if that depends on the data, all branches and a select, as under `vmap`."""
    which, *operands = operands
    if is_numeric(which):
        branch = branches[int(np.clip(int(which), 0, len(branches) - 1))]
        return evaluate(branch.jaxpr, branch.consts, operands, wanted)
    index = which.item()
    cases = []
    for i, branch in enumerate(branches):
        is_taken = choose(index, *(i == k for k in range(len(branches))), dtype=np.dtype(bool))
        with index.graph.suppose(is_taken):
            cases.append(evaluate(branch.jaxpr, branch.consts, operands, wanted))
    return [
        choose_array(index, options, aval.dtype) if here else None
        for options, aval, here in zip(zip(*cases, strict=True), branches[0].out_avals, wanted, strict=True)
    ]


def _while(operands, wanted, *, cond_nconsts, cond_jaxpr, body_nconsts, body_jaxpr):
    """Rounds that are known to happen are written out; from the first that depends on the data on, it is a `Loop`."""
    consts, carry = operands[: cond_nconsts + body_nconsts], operands[cond_nconsts + body_nconsts :]

    def advance(consts, carry):
        return evaluate(body_jaxpr.jaxpr, body_jaxpr.consts, [*consts[cond_nconsts:], *carry])

    def test(consts, carry):
        return evaluate(cond_jaxpr.jaxpr, cond_jaxpr.consts, [*consts[:cond_nconsts], *carry])

    while is_numeric(*(continues := test(consts, carry))):
        if not continues[0]:
            return carry
        carry = advance(consts, carry)
    return _loop(advance, test, consts, [*continues, *carry], [*cond_jaxpr.out_avals, *body_jaxpr.out_avals], wanted)


def _loop(advance, test, consts, initial, avals, wanted):
    """The carry after the rounds of a loop; `initial` and `avals` begin with the result of the test."""

    def advance_elements(capture, elements):
        inside = [x if is_numeric(x) else pack([capture(part) for part in x.flat], x.shape) for x in consts]
        _, *carry = _join_elements(elements, avals)
        carry = advance(inside, carry)
        return _split_elements([*test(inside, carry), *carry])

    dtypes = [np.dtype(aval.dtype) for aval in avals for _ in range(aval.size)]
    wanted = [False, *wanted]
    used = [here for aval, here in zip(avals, wanted, strict=True) for _ in range(aval.size)]
    results = trace_loop(advance_elements, _split_elements(initial), dtypes, used)
    _, *arrays = _join_elements(results, avals)
    return [array if here else None for array, here in zip(arrays, wanted[1:], strict=True)]


def _split_elements(arrays) -> list:
    return [x for array in arrays for x in as_objects(np.asarray(array)).flat]


def _join_elements(elements: list, avals) -> list[np.ndarray]:
    """Arrays from their elements, in order."""
    remaining = iter(elements)
    return [
        simplify_dtype(pack(list(itertools.islice(remaining, aval.size)), aval.shape), aval.dtype) for aval in avals
    ]


CONTROL = {
    "jit": _call,
    "call_hi_primitive": _call_high,
    "remat2": _call,
    "custom_jvp_call": _call,
    "custom_vjp_call": _call,
    "scan": _scan,
    "cond": _cond,
    "while": _while,
}
