"""Plain values as YAML, as people write numbers: 1e-3 is one, which YAML 1.1 takes for a text."""

from __future__ import annotations

import re
from typing import Any

import yaml

FLOAT = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")


class Loader(yaml.SafeLoader):
    """Safe; a name that is there twice is refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key} is there twice", node.start_mark)
        return super().construct_mapping(node, deep)


class Dumper(yaml.SafeDumper):
    """Quotes a text that `Loader` would read as a number."""


for each in (Loader, Dumper):
    each.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, list("-+0123456789"))


def dump(values: dict[str, Any]) -> str:
    """The values as text, in their order; tuples become lists."""
    return yaml.dump(values, Dumper=Dumper, default_flow_style=False, allow_unicode=True, sort_keys=False)


def load(text: str) -> Any:
    """What the text says; raises yaml.YAMLError where it is no YAML."""
    return yaml.load(text, Loader)
