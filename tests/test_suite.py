"""The suite itself: the list of files whose tests are slow."""

import pytest
from conftest import ROOT, SLOW


@pytest.mark.parametrize("name", sorted(SLOW))
def test_slow_files_are_there(name):
    """What is renamed or removed leaves the list with it."""
    assert (ROOT / name).is_file()
