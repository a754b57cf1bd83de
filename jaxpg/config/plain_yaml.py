"""Plain values as YAML 1.2: null, true, false, numbers, text, and lists and mappings of these.

PyYAML follows YAML 1.1, in which 1e-3 is a text, 1:30 the number 90, `no` is false and 2026-01-01 a date.
"""

from __future__ import annotations

import re
from typing import Any, ClassVar

import yaml

# YAML 1.2.2, section 10.3.2, and `_` between the digits of numbers.
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
    """Safe; a name that is there twice is refused."""

    yaml_implicit_resolvers: ClassVar[dict] = {}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key} is there twice", node.start_mark)
        return super().construct_mapping(node, deep)


class Dumper(yaml.SafeDumper):
    """Quotes a text that `Loader` would read as something else."""

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
    """What the text says; raises yaml.YAMLError if it is no YAML."""
    return yaml.load(text, Loader)


def load_value(text: str) -> Any:
    """One value: a list, mapping or quoted text as in YAML, and else a number, true, false, null or the text as it is.

    >>> load_value("[1e-3, a]"), load_value("null"), load_value("@a: #b"), load_value("'3'")
    ([0.001, 'a'], None, '@a: #b', '3')
    """
    if text[:1] in ("[", "{", "'", '"'):
        return load(text)
    loader = Loader("")
    tag = loader.resolve(yaml.ScalarNode, text, (True, False))
    return loader.construct_object(yaml.ScalarNode(tag, text))
