"""Algorithms, networks and environments that can be chosen by name, with their options."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import envs
from jaxpg.config import schema


class Entry(NamedTuple):
    """An algorithm or network that can be chosen by name.

    Attributes:
      options: dataclass of its options.
      build: the function that builds it, or its place "module:name", which is imported on first use so that options can
        be read without the programs. For algorithms `build(config, env) -> Algorithm`, for networks
        `build(options, observation_size, action_size) -> Networks`.
    """

    options: type
    build: Callable[..., Any] | str

    def make(self, *arguments: Any) -> Any:
        """Calls `build`, importing it if necessary."""
        if callable(self.build):
            return self.build(*arguments)
        module, _, name = self.build.partition(":")
        return getattr(importlib.import_module(module), name)(*arguments)


class Options(Mapping[str, type]):
    """A view of the options of each entry, by name, that includes entries added later.

    Args:
      entries: returns the entries by name.
      attribute: the attribute of an entry with its options.
    """

    def __init__(self, entries: Callable[[], Mapping[str, Any]], attribute: str):
        self._entries, self._attribute = entries, attribute

    def __getitem__(self, name: str) -> type:
        return getattr(self._entries()[name], self._attribute)

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries())

    def __len__(self) -> int:
        return len(self._entries())


ALGORITHMS: dict[str, Entry] = {
    "td": Entry(schema.TD, "jaxpg.program.algorithms:make_td"),
    "ppo": Entry(schema.PPO, "jaxpg.program.algorithms:make_ppo"),
    "reinforce": Entry(schema.Reinforce, "jaxpg.program.algorithms:make_reinforce"),
    "online": Entry(schema.Online, "jaxpg.program.algorithms:make_online"),
}
NETWORKS: dict[str, Entry] = {
    "mlp": Entry(schema.MLP, "jaxpg.program.networks:make_mlp"),
    "linear": Entry(schema.Linear, "jaxpg.program.networks:make_linear"),
}
GROUPS: dict[str, Mapping[str, type]] = {
    "env": Options(lambda: envs.REGISTRY, "config"),
    "algo": Options(lambda: ALGORITHMS, "options"),
    "network": Options(lambda: NETWORKS, "options"),
}


def find_option_fields(choices: Mapping[str, str]) -> dict[str, dataclasses.Field]:
    """The field of every option under these choices, by its name on the command line."""
    fields = {field.name: field for field in dataclasses.fields(schema.Run)}
    for group, choice in choices.items():
        fields |= {f"{group}.{field.name}": field for field in dataclasses.fields(GROUPS[group][choice])}
    return fields
