"""The suite itself: what it leaves to `pytest -m study`."""

import ast

import pytest
from conftest import ROOT, SLOW


@pytest.mark.parametrize("name", sorted(SLOW - {""}))
def test_slow_tests_are_there(name):
    """A test that is renamed or removed leaves the list with it."""
    path, _, test = name.partition("::")
    defined = {node.name for node in ast.walk(ast.parse((ROOT / path).read_text())) if hasattr(node, "name")}
    assert test.partition("[")[0] in defined
