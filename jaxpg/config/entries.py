"""What can be chosen by name: algorithms, networks and environments, with their options."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import envs
from jaxpg.config import schema


class Entry(NamedTuple):
    """What can be chosen by name: its options, and the function that makes it of them.

    Attributes:
      options: dataclass of its options.
      build: the function, or where it is, "module:name": it is imported at its first use, so that options are read
        without the programs. Of an algorithm `build(config, env) -> Algorithm`, of networks
        `build(options, observation_size, action_size) -> Networks`.
    """

    options: type
    build: Callable[..., Any] | str

    def built(self, *arguments: Any) -> Any:
        """What `build` makes of the arguments."""
        if callable(self.build):
            return self.build(*arguments)
        module, _, name = self.build.partition(":")
        return getattr(importlib.import_module(module), name)(*arguments)


class Options(Mapping[str, type]):
    """The options of every entry by its name, of those too that are added later.

    Args:
      entries: gives them by name.
      attribute: of an entry, which holds its options.
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


def option_fields(choices: Mapping[str, str]) -> dict[str, dataclasses.Field]:
    """Every option under these choices, by its name on the command line."""
    fields = {field.name: field for field in dataclasses.fields(schema.Run)}
    for group, choice in choices.items():
        fields |= {f"{group}.{field.name}": field for field in dataclasses.fields(GROUPS[group][choice])}
    return fields
