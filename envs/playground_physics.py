"""MuJoCo Playground's environments with another MuJoCo step than MJX's.

Playground has no choice of physics: all its environments call `mjx_env.make_data`, `mjx.forward` and `mjx_env.step`.
While one of them is traced, these three names stand for functions of `Data`, which has only the fields that the
environment reads or sets. They are found by tracing it once with a `Data` that has every field and notes which are
used.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from envs.options import OptionError
from envs.physics import compile_forward, compile_step
from envs.physics.fields import COMPUTED, INPUTS, STATE, find_types
from envs.physics.forward import normalize_quaternions
from envs.physics.models import import_mjx

FIELDS = (*INPUTS, *COMPUTED)  # of mjx.Data
ALWAYS = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")
_tracing = threading.RLock()  # held while the names stand for other functions


def _ignore(name: str) -> None:
    """Notes nothing."""


@jax.tree_util.register_pytree_with_keys_class
class Data:
    """Some fields of `mjx.Data`, as attributes.

    Args:
      fields: arrays by name.
      note: called with the name of each field that is read or set.
    """

    def __init__(self, fields: Mapping[str, Any], note: Callable[[str], None] = _ignore):
        self._fields, self._note = dict(fields), note

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # not set yet while copying
            raise AttributeError(name)
        self._note(name)
        if name not in self._fields:
            raise AttributeError(name)
        return self._fields[name]

    def replace(self, **fields: Any) -> Data:
        """The data with other values; the type of a field stays."""
        for name in fields:
            self._note(name)
        known = {name: jnp.asarray(x, self._fields[name].dtype) for name, x in fields.items() if name in self._fields}
        return Data(self._fields | known, self._note)

    def select(self, names: Collection[str]) -> list[Any]:
        """The values of some fields, which are not noted."""
        return [self._fields[name] for name in names]

    def tree_flatten_with_keys(self):
        names = tuple(sorted(self._fields))
        return [(jax.tree_util.GetAttrKey(name), self._fields[name]) for name in names], (names, self._note)

    @classmethod
    def tree_unflatten(cls, structure, values):
        names, note = structure
        return cls(dict(zip(names, values, strict=True)), note)


class Physics:
    """Stands for MJX in one environment.

    Args:
      env: Playground's.
      physics: "scalar" or "mujoco".

    Raises:
      OptionError: the environment reads a field that is not one of `compile_step`'s outputs.
    """

    def __init__(self, env: Any, physics: str):
        self.model, self.physics = env.mj_model, physics
        used = find_used_fields(env)
        always = [name for name in ALWAYS if name != "act" or self.model.na]
        self.inputs = tuple(name for name in INPUTS if name in {*always, *used})
        self.derived = tuple(name for name in FIELDS if name in used and name not in INPUTS)
        self.carried = tuple(name for name in self.inputs if name in STATE)
        self._forward = compile_forward(self.model, inputs=self.inputs, outputs=self.derived, physics=physics)
        self._compile_step = functools.cache(self._compile_step)
        self._compile_step(env.n_substeps)

    def _compile_step(self, num_substeps: int):
        outputs = (*self.carried, *self.derived)
        return compile_step(self.model, num_substeps, inputs=self.inputs, outputs=outputs, physics=self.physics)

    def make_data(self, model: Any, **given: Any) -> Data:
        """The initial data, with the given fields; other arguments of Playground's function are MJX's."""
        return Data(make_fields(self.model, (*self.inputs, *self.derived), given))

    def forward(self, model: Any, data: Data) -> Data:
        """The data with all that follows from its state."""
        data = data.replace(qpos=normalize_quaternions(self.model, data.qpos))
        return data.replace(**dict(zip(self.derived, self._forward(*data.select(self.inputs)), strict=True)))

    def step(self, model: Any, data: Data, action: jax.Array, n_substeps: int = 1) -> Data:
        """The data after so many physics steps under the same control."""
        data = data.replace(ctrl=action)
        values = self._compile_step(n_substeps)(*data.select(self.inputs))
        return data.replace(**dict(zip((*self.carried, *self.derived), values, strict=True)))

    def in_place(self) -> contextlib.AbstractContextManager[None]:
        """Within it, Playground's functions are these."""
        return stand_in(self.make_data, self.forward, self.step)


@contextlib.contextmanager
def stand_in(make_data: Callable, forward: Callable, step: Callable) -> Iterator[None]:
    """Within it, the names that Playground's environments call stand for these functions."""
    # Its environments look the names up in this module, which has no public place.
    from mujoco_playground._src import mjx_env  # pyright: ignore[reportMissingImports] # an extra of its own

    mjx = import_mjx()
    functions = ((mjx_env, "make_data", make_data), (mjx_env, "step", step), (mjx, "forward", forward))
    with _tracing:
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in functions]
        try:
            for owner, name, function in functions:
                setattr(owner, name, function)
            yield
        finally:
            for owner, name, function in before:
                setattr(owner, name, function)


def find_used_fields(env: Any) -> set[str]:
    """The fields of MuJoCo's data that an environment reads or sets; raises OptionError as `Physics` does."""
    used: set[str] = set()

    def make_data(model, **given):
        return Data(make_fields(env.mj_model, FIELDS, given), used.add)

    def play(key, action):
        return env.step(env.reset(key), action)

    key, action = jax.eval_shape(lambda: (jax.random.PRNGKey(0), jnp.zeros(env.action_size)))
    with stand_in(make_data, lambda model, data: data, lambda model, data, action, n_substeps=1: data):
        try:
            jax.eval_shape(play, key, action)
        except AttributeError as error:
            if not used - set(FIELDS):
                raise
            raise OptionError([_describe_unknown(env, used)]) from error
    return used & set(FIELDS)


def _describe_unknown(env: Any, used: set[str]) -> str:
    names = ", ".join(f"data.{name}" for name in sorted(used - set(FIELDS)))
    return f"{type(env).__name__} reads {names}, which only MJX has: env.physics=mjx"


def make_fields(model: mujoco.MjModel, names: Collection[str], given: Mapping[str, Any]) -> dict[str, jax.Array]:
    """The named fields of MuJoCo's initial data, with other values where given."""
    initial = mujoco.MjData(model)
    fields = {}
    for name, kind in zip(names, find_types(model, tuple(names)), strict=True):
        value = given.get(name)
        fields[name] = jnp.asarray(getattr(initial, name) if value is None else value, kind.dtype).reshape(kind.shape)
    return fields
