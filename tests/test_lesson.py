"""What docs/lesson.md names exists."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from jaxpg.run.config import compose

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "lesson.md").read_text(encoding="utf-8")


def missing(page):
    """The references `path` and `path:name` of a page that lead nowhere, and how many there are in all."""
    references = re.findall(r"`((?:jaxpg|envs|tests|experiments)/[\w/]+\.\w+)(?::(\w+))?`", page)
    return [f"{path}:{name}" for path, name in references if not exists(path, name)], len(references)


def exists(path, name):
    path = ROOT / path
    return path.exists() and (not name or name in names(path))


def names(path):
    """Functions, classes and constants of a module."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.AnnAssign):
            yield node.target.id


def test_every_reference_leads_somewhere():
    lost, count = missing(PAGE)
    assert lost == []
    assert count > 40


@pytest.mark.parametrize(
    "reference", ["jaxpg/returns.py:td_eror", "jaxpg/return.py", "tests/test_returns.py:td_errors"], ids=str
)
def test_references_that_lead_nowhere_are_found(reference):
    path, _, name = reference.partition(":")
    assert missing(f"see `{reference}`") == ([f"{path}:{name}"], 1)


def test_commands_are_complete():
    commands = [line for line in PAGE.splitlines() if line.startswith("python -m jaxpg.train ")]
    assert len(commands) == 3
    for command in commands:
        compose(shlex.split(command)[3:])


def test_formulas_are_closed():
    lines = PAGE.splitlines()
    fences = [i for i, line in enumerate(lines) if line.strip() == "$$"]
    assert len(fences) >= 10
    assert len(fences) % 2 == 0
    for start, end in zip(fences[::2], fences[1::2], strict=True):
        assert lines[start - 1] == lines[end + 1] == ""
        assert "" not in lines[start:end]
