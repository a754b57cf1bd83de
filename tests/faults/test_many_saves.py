"""What a save leaves in memory: nothing that grows without end."""

import gc
import sys

import numpy as np
import pytest

from jaxpg.store.checkpoint import Checkpoints

SAVES, ARRAYS = 150, 20


def save(checkpoints, steps):
    for step in steps:
        checkpoints.replace(step, {f"x{i}": np.full(100, step + i) for i in range(ARRAYS)}, {"config": {"seed": step}})


@pytest.mark.faults
def test_saves_leave_no_objects_behind(tmp_path):
    """But for a few short texts of each array, which tensorstore (0.1.86) forgets to release: 300 bytes."""
    checkpoints = Checkpoints(tmp_path)
    save(checkpoints, range(50))  # threads begin, caches fill
    gc.collect()
    objects, blocks = len(gc.get_objects()), sys.getallocatedblocks()
    save(checkpoints, range(50, 50 + SAVES))
    gc.collect()
    assert len(gc.get_objects()) - objects < SAVES
    assert sys.getallocatedblocks() - blocks < 6 * SAVES * ARRAYS
