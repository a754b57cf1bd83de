"""Plain values as YAML 1.2: null, true, false, numbers, text, and lists and mappings of these.

PyYAML follows YAML 1.1, in which 1e-3 is a text, 1:30 is the number 90, `no` is false and 2026-01-01 is a date.
"""

from __future__ import annotations

import re
from typing import Any, ClassVar

import yaml

# As in YAML 1.2.2, section 10.3.2, but also with `_` between digits.
RESOLVERS = {
    "null": (r"null|Null|NULL|~|", ["", *"nN~"]),
    "bool": (r"true|True|TRUE|false|False|FALSE", [*"tTfF"]),
    "int": (r"[-+]?[0-9](_?[0-9])*", [*"-+0123456789"]),
    "float": (
        r"[-+]?(\.[0-9](_?[0-9])*|[0-9](_?[0-9])*(\.([0-9](_?[0-9])*)?)?)([eE][-+]?[0-9]+)?"
        r"|[-+]?\.?(inf|Inf|INF)|\.?(nan|NaN|NAN)",
        [*"-+.0123456789iInN"],
    ),
}


class Loader(yaml.SafeLoader):
    """A safe loader that refuses duplicate names."""

    yaml_implicit_resolvers: ClassVar[dict] = {}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key} appears twice", node.start_mark)
        return super().construct_mapping(node, deep)


class Dumper(yaml.SafeDumper):
    """A dumper that quotes every text that `Loader` would read as something else."""

    yaml_implicit_resolvers: ClassVar[dict] = {}


def _construct_int(loader: Loader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node))


def _construct_float(loader: Loader, node: yaml.ScalarNode) -> float:
    return float(re.sub(r"^([-+]?)\.(?=[a-zA-Z])", r"\1", loader.construct_scalar(node)))


for name, (pattern, first) in RESOLVERS.items():
    for each in (Loader, Dumper):
        each.add_implicit_resolver(f"tag:yaml.org,2002:{name}", re.compile(rf"(?:{pattern})\Z"), first)
Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)


def dump(values: dict[str, Any]) -> str:
    """The values as text, in their order; tuples become lists."""
    return yaml.dump(values, Dumper=Dumper, default_flow_style=False, allow_unicode=True, sort_keys=False)


def load(text: str) -> Any:
    """The values in a text; raises yaml.YAMLError if it is not YAML."""
    return yaml.load(text, Loader)


def load_value(text: str) -> Any:
    """One value: a list, mapping or quoted text as in YAML, else a number, true, false, null or the text itself.

    >>> load_value("[1e-3, a]"), load_value("null"), load_value("@a: #b"), load_value("'3'")
    ([0.001, 'a'], None, '@a: #b', '3')
    """
    if text[:1] in ("[", "{", "'", '"'):
        return load(text)
    loader = Loader("")
    tag = loader.resolve(yaml.ScalarNode, text, (True, False))
    return loader.construct_object(yaml.ScalarNode(tag, text))
