"""Programs of scalar equations as text, kept between processes.

Making a program of a model takes a second or more, most of it MJX's: its import, and the tracing of its step. Reading
one takes milliseconds, and what is read is what was written, expression for expression. Without `kept_in` every program
is made anew.
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
    """Texts by name, from one process to the next."""

    def read(self, name: str) -> str | None:
        """The text, as it was written; None where there is none."""

    def write(self, name: str, text: str) -> None:
        """Keeps the text, if that is possible."""


_store: Store | None = None


@contextlib.contextmanager
def kept_in(store: Store | None) -> Iterator[None]:
    """Programs that are asked for inside come from the store, or are made and written there."""
    global _store
    before, _store = _store, store
    try:
        yield
    finally:
        _store = before


def kept(name: str, make: Callable[[], Program]) -> Program:
    """The program of that name, from the store if there is one that has it."""
    text = None if _store is None else _store.read(name)
    if text is not None:
        return from_text(text)
    program = make()
    if _store is not None:
        _store.write(name, to_text(program))
    return program


def name_of(model: mujoco.MjModel, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> str:
    """A name for the program of a model's step, other than that of any program that may differ from it."""
    return hashlib.sha256(
        model_digest(model) + repr((inputs, outputs, jax.config.values["jax_enable_x64"], *_makers())).encode()
    ).hexdigest()


@functools.cache
def _makers() -> tuple[str, ...]:
    """What makes a program of a model: the packages' versions and the text of this one."""
    versions = (importlib.metadata.version(name) for name in ("jax", "mujoco", "mujoco-mjx", "numpy"))
    sources = sorted(Path(__file__).parent.rglob("*.py"))
    return (*versions, hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest())


# --- a program as JSON ------------------------------------------------------------------------------------------------
# An element is a constant as it is, or [i] for expression i. Expressions have the order in which they were made, which
# is what the order of a program's equations follows.


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
        "expressions": [[x.op, [element(arg) for arg in x.args], _plain(x.params), x.dtype.name] for x in expressions],
        "inputs": [array(x) for x in program.inputs],
        "outputs": [[*array(x), dtype.name] for x, dtype in zip(program.outputs, program.output_dtypes, strict=True)],
    }
    return json.dumps(content)


def from_text(text: str) -> Program:
    """The program that `to_text` has written; a function of as many arrays as it has inputs."""
    content, graph = json.loads(text), Graph()
    expressions: list[Expression] = []

    def element(x: Any) -> Any:
        return expressions[x[0]] if isinstance(x, list) else x

    def array(shape: list[int], elements: list) -> np.ndarray:
        return pack([element(x) for x in elements], tuple(shape))

    for op, operands, params, dtype in content["expressions"]:
        if op != "input" and op not in NUMPY:
            raise ValueError(f"{op} is no operation of scalar equations")
        args = tuple(map(element, operands))
        expressions.append(Expression(graph, op, args, _parameters(params), np.dtype(dtype)))
    outputs = [array(shape, elements) for shape, elements, _ in content["outputs"]]
    return Program(
        [array(*x) for x in content["inputs"]],
        outputs,
        [np.dtype(dtype) for *_, dtype in content["outputs"]],
        jax.tree.structure(tuple(content["inputs"]), is_leaf=lambda x: isinstance(x, list)),
        jax.tree.structure(tuple(outputs)),
    )


def _plain(params: tuple) -> list:
    return [[name, {"dtype": value.name} if isinstance(value, np.dtype) else value] for name, value in params]


def _parameters(plain: list) -> tuple:
    return tuple((name, np.dtype(value["dtype"]) if isinstance(value, dict) else value) for name, value in plain)
