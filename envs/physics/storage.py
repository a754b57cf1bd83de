"""Stores programs of scalar equations as text, for later processes.

Making the program of a model takes a second or more, mostly for importing MJX and tracing its step. Reading one takes
milliseconds, and gives the same expressions. Without `use_store` every program is made anew.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import jax
import numpy as np

from envs.physics.arrays import as_objects, pack
from envs.physics.expressions import Expression, Graph
from envs.physics.folding import NUMPY
from envs.physics.interpreter import Program
from envs.physics.models import model_digest

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


def make_name(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> str:
    """A name for the program of a model's step; programs that may differ have different names."""
    return hashlib.sha256(
        model_digest(model) + repr((inputs, outputs, jax.config.values["jax_enable_x64"], *_list_versions())).encode()
    ).hexdigest()


@functools.cache
def _list_versions() -> tuple[str, ...]:
    """The versions of the code that makes programs: of the packages, and a digest of this package's source."""
    versions = (importlib.metadata.version(name) for name in ("jax", "mujoco", "mujoco-mjx", "numpy"))
    sources = sorted(Path(__file__).parent.rglob("*.py"))
    return (*versions, hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest())


# --- a program as JSON ------------------------------------------------------------------------------------------------
# An element is a constant itself, or [i] for expression i. Expressions are in order of creation, which is also the
# order of a program's equations.


def to_text(program: Program) -> str:
    """The program as JSON; `from_text` is its inverse."""
    inputs = [x for array in program.inputs for x in array.flat]
    expressions = sorted({x.index: x for x in (*inputs, *program.equations())}.values(), key=lambda x: x.index)
    numbers = {x.index: i for i, x in enumerate(expressions)}

    def element(x: Any) -> Any:
        return [numbers[x.index]] if isinstance(x, Expression) else x

    def array(x: np.ndarray) -> list:
        return [list(x.shape), [element(part) for part in as_objects(x).flat]]

    content = {
        "expressions": [
            [x.op, [element(arg) for arg in x.args], _encode_params(x.params), x.dtype.name] for x in expressions
        ],
        "inputs": [array(x) for x in program.inputs],
        "outputs": [[*array(x), dtype.name] for x, dtype in zip(program.outputs, program.output_dtypes, strict=True)],
    }
    return json.dumps(content)


def from_text(text: str) -> Program:
    """The program in a text of `to_text`, as a function of one array per input."""
    content, graph = json.loads(text), Graph()
    expressions: list[Expression] = []

    def element(x: Any) -> Any:
        return expressions[x[0]] if isinstance(x, list) else x

    def array(shape: list[int], elements: list) -> np.ndarray:
        return pack([element(x) for x in elements], tuple(shape))

    for op, operands, params, dtype in content["expressions"]:
        if op != "input" and op not in NUMPY:
            raise ValueError(f"{op} is not an operation of scalar equations")
        args = tuple(map(element, operands))
        expressions.append(Expression(graph, op, args, _decode_params(params), np.dtype(dtype)))
    outputs = [array(shape, elements) for shape, elements, _ in content["outputs"]]
    return Program(
        [array(*x) for x in content["inputs"]],
        outputs,
        [np.dtype(dtype) for *_, dtype in content["outputs"]],
        jax.tree.structure(tuple(content["inputs"]), is_leaf=lambda x: isinstance(x, list)),
        jax.tree.structure(tuple(outputs)),
    )


def _encode_params(params: tuple) -> list:
    return [[name, {"dtype": value.name} if isinstance(value, np.dtype) else value] for name, value in params]


def _decode_params(params: list) -> tuple:
    return tuple((name, np.dtype(value["dtype"]) if isinstance(value, dict) else value) for name, value in params)
