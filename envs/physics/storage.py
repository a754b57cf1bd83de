"""Stores programs of scalar equations as text, for later processes.

Making the program of a model takes a second or more, mostly for importing MJX and tracing the step. Reading one takes
milliseconds, and gives the same expressions. Without `use_store` every program is made anew.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import jax
import numpy as np

from envs.physics.arrays import as_objects, pack
from envs.physics.expressions import Expression, Graph, Scalar
from envs.physics.folding import NUMPY
from envs.physics.interpreter import Program
from envs.physics.loops import Loop
from envs.physics.models import model_digest
from envs.physics.stages import find_loops, sort_equations

if TYPE_CHECKING:
    import mujoco


class Store(Protocol):
    """Texts by name, which persist between processes."""

    def read(self, name: str) -> str | None:
        """The text as it was written; None if there is none."""

    def write(self, name: str, text: str) -> None:
        """Stores the text, if possible."""


_store: Store | None = None


@contextlib.contextmanager
def use_store(store: Store | None) -> Iterator[None]:
    """Inside this context, programs are read from the store, or made and written to it."""
    global _store
    before, _store = _store, store
    try:
        yield
    finally:
        _store = before


def load_or_make(name: str, make: Callable[[], Program]) -> Program:
    """The program with this name, from the store if it has it, else from `make`."""
    text = None if _store is None else _store.read(name)
    if text is not None:
        return from_text(text)
    program = make()
    if _store is not None:
        _store.write(name, to_text(program))
    return program


def make_name(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...], *options: object) -> str:
    """A name for the program of a model's step; programs that may differ have different names."""
    return hashlib.sha256(
        model_digest(model)
        + repr((inputs, outputs, options, jax.config.values["jax_enable_x64"], *_list_versions())).encode()
    ).hexdigest()


@functools.cache
def _list_versions() -> tuple[str, ...]:
    """The versions of the code that makes programs: of the packages, and a digest of this package's source."""
    versions = (importlib.metadata.version(name) for name in ("jax", "mujoco", "mujoco-mjx", "numpy"))
    sources = sorted(Path(__file__).parent.rglob("*.py"))
    return (*versions, hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest())


# --- a program as JSON ------------------------------------------------------------------------------------------------
# An element is a constant itself, or [i] for expression i. Expressions are in order of creation, which is also the
# order of a program's equations. A loop is a list of expressions of its own, by its number; those inside it come first.


def to_text(program: Program) -> str:
    """The program as JSON; `from_text` is its inverse."""
    loops = {loop: i for i, loop in enumerate(find_loops(program.equations()))}
    inputs = [x for array in program.inputs for x in array.flat]
    expressions, element = _encode_expressions([*inputs, *program.equations()], loops)

    def array(x: np.ndarray) -> list:
        return [list(x.shape), [element(part) for part in as_objects(x).flat]]

    content = {
        "loops": [_encode_loop(loop, loops) for loop in loops],
        "expressions": expressions,
        "inputs": [array(x) for x in program.inputs],
        "outputs": [[*array(x), dtype.name] for x, dtype in zip(program.outputs, program.output_dtypes, strict=True)],
    }
    return json.dumps(content)


def _encode_loop(loop: Loop, loops: dict[Loop, int]) -> dict[str, list]:
    expressions, element = _encode_expressions([*loop.carried, *loop.captured, *sort_equations(loop.outputs())], loops)
    ends = {"carried": loop.carried, "captured": loop.captured, "following": loop.following}
    return {"expressions": expressions, **{name: list(map(element, end)) for name, end in ends.items()}}


def _encode_expressions(
    expressions: Iterable[Expression], loops: dict[Loop, int]
) -> tuple[list, Callable[[Scalar], Any]]:
    """The expressions, and the function that encodes an element of an array of them."""
    in_order = sorted({x.index: x for x in expressions}.values(), key=lambda x: x.index)
    numbers = {x.index: i for i, x in enumerate(in_order)}

    def element(x: Scalar) -> Any:
        return [numbers[x.index]] if isinstance(x, Expression) else x

    def parameter(value: Any) -> Any:
        if isinstance(value, Loop):
            return {"loop": loops[value]}
        return {"dtype": value.name} if isinstance(value, np.dtype) else value

    return [
        [x.op, list(map(element, x.args)), [[name, parameter(value)] for name, value in x.params], x.dtype.name]
        for x in in_order
    ], element


def from_text(text: str) -> Program:
    """The program in a text of `to_text`, as a function of one array per input."""
    content = json.loads(text)
    loops: list[Loop] = []
    for parts in content["loops"]:
        element = _decode_expressions(parts.pop("expressions"), loops)
        loops.append(Loop(**{name: tuple(map(element, end)) for name, end in parts.items()}))
    element = _decode_expressions(content["expressions"], loops)

    def array(shape: list[int], elements: list) -> np.ndarray:
        return pack(list(map(element, elements)), tuple(shape))

    outputs = [array(shape, elements) for shape, elements, _ in content["outputs"]]
    return Program(
        [array(*x) for x in content["inputs"]],
        outputs,
        [np.dtype(dtype) for *_, dtype in content["outputs"]],
        jax.tree.structure(tuple(content["inputs"]), is_leaf=lambda x: isinstance(x, list)),
        jax.tree.structure(tuple(outputs)),
    )


def _decode_expressions(content: list, loops: list[Loop]) -> Callable[[Any], Any]:
    """The function that decodes an element of an array of the expressions."""
    graph = Graph()
    expressions: list[Expression] = []

    def element(x: Any) -> Any:
        return expressions[x[0]] if isinstance(x, list) else x

    def parameter(value: Any) -> Any:
        if isinstance(value, dict):
            return loops[value["loop"]] if "loop" in value else np.dtype(value["dtype"])
        return value

    for op, operands, params, dtype in content:
        if op not in ("input", "loop") and op not in NUMPY:
            raise ValueError(f"{op} is not an operation of scalar equations")
        args = tuple(map(element, operands))
        named = tuple((name, parameter(value)) for name, value in params)
        expressions.append(Expression(graph, op, args, named, np.dtype(dtype)))
    return element
