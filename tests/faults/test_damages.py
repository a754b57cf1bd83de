"""A checkpoint damaged in any way is never taken for a sound one: the one before it is used, or none.

`pytest -m faults tests/faults` makes two hundred random damages.
"""

import random
import shutil

import numpy as np
import pytest

from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.checkpoint_errors import CheckpointError

FEW, MANY = range(20, 40), 200  # 27 is one that only the digests of the arrays tell
STEPS = (1, 2, 3)


def content(step):
    """Arrays of every kind that a state has: large, small, empty, whole numbers."""
    rng = np.random.default_rng(step)
    return {
        "params": {"kernel": rng.normal(size=(64, 64)).astype(np.float32), "bias": np.zeros(3, np.float32)},
        "count": np.int32(step),
        "key": rng.integers(2**32, size=2, dtype=np.uint32),
        "nothing": np.zeros((0, 4), np.float32),
    }


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints") / "checkpoints"
    checkpoints = Checkpoints(folder)
    for step in STEPS:
        checkpoints.save(step, content(step), {"config": {"seed": step}})
    return folder


def truncate(path, rng):
    path.write_bytes(path.read_bytes()[: rng.randrange(max(path.stat().st_size, 1))])


def flip(path, rng):
    data = bytearray(path.read_bytes())
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def scramble(path, rng):
    data = bytearray(path.read_bytes())
    begin = rng.randrange(len(data) + 1)
    data[begin : begin + 512] = rng.randbytes(len(data[begin : begin + 512]))
    path.write_bytes(data)


def append(path, rng):
    with path.open("ab") as file:
        file.write(rng.randbytes(rng.randrange(1, 100)))


def remove(path, rng):
    path.unlink()


def swap(path, rng):
    """With the same file of the other damaged checkpoint, or with any file of its own."""
    root = next(parent for parent in path.parents if parent.name == "checkpoints")
    number = path.relative_to(root).parts[0]
    other = root / {"3": "2", "2": "3"}[number] / path.relative_to(root / number)
    if not other.is_file() or rng.random() < 0.3:
        other = rng.choice(files(root / number))
    mine, theirs = path.read_bytes(), other.read_bytes()
    path.write_bytes(theirs)
    other.write_bytes(mine)


def become_a_folder(path, rng):
    path.unlink()
    path.mkdir()


KINDS = (truncate, flip, scramble, append, remove, swap, become_a_folder)


def files(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=[] if seed in FEW else [pytest.mark.faults]) for seed in range(MANY)]
)
def test_random_damages(saved, tmp_path, seed):
    """One to four files of the two newest of three: the newest that is sound is read, as it was written."""
    rng = random.Random(seed)
    folder = tmp_path / "checkpoints"
    shutil.copytree(saved, folder)
    for _ in range(rng.choice([1, 1, 2, 4])):
        step = rng.choice([3, 3, 3, 2])
        candidates = files(folder / str(step))
        if candidates:
            rng.choice(KINDS)(rng.choice(candidates), rng)
    checkpoints = Checkpoints(folder)
    step, problems = checkpoints.newest_sound()
    restored, expected = checkpoints.restore(step, content(step)), content(step)
    for name in ("kernel", "bias"):
        np.testing.assert_array_equal(restored["params"][name], expected["params"][name])
    for name in ("count", "key", "nothing"):
        np.testing.assert_array_equal(restored[name], expected[name])
    assert all(len(problem.splitlines()) == 1 for problem in problems)
    assert all(f"/{number}: " in problem for number, problem in zip(range(3, step, -1), problems, strict=True))


def test_a_checkpoint_under_another_number_is_not_taken(saved, tmp_path):
    folder = tmp_path / "checkpoints"
    shutil.copytree(saved, folder)
    shutil.rmtree(folder / "3")
    (folder / "2").rename(folder / "3")
    step, (problem,) = Checkpoints(folder).newest_sound()
    assert step == 1
    assert problem.endswith("/3: damaged, it is what was saved as 2")


def test_where_nothing_is_sound_it_is_an_error_and_nothing_is_deleted(saved, tmp_path):
    folder = tmp_path / "checkpoints"
    shutil.copytree(saved, folder)
    for path in files(folder):
        if path.parent.name == "d":
            flip(path, random.Random(0))
    with pytest.raises(CheckpointError, match="and none before it is sound"):
        Checkpoints(folder).newest_sound()
    assert {path.name for path in folder.iterdir()} == {str(step) for step in STEPS}
