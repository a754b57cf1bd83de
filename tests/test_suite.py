"""The suite itself: the list of slow tests."""

import ast

import pytest
from conftest import ROOT, SLOW


@pytest.mark.parametrize("name", sorted(SLOW))
def test_slow_tests_are_there(name):
    """What is renamed or removed leaves the list with it."""
    path, _, test = name.partition("::")
    defined = {node.name for node in ast.walk(ast.parse((ROOT / path).read_text())) if hasattr(node, "name")}
    assert not test or test in defined
