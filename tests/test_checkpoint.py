"""What a checkpoint gives back is what was saved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.checkpoint_errors import CheckpointError


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg"])
@pytest.mark.parametrize("shapes_only", [False, True])
def test_random_keys_come_back_as_keys(impl, shapes_only, tmp_path):
    """Also where the template has shapes and types only, as that of a resumed run has."""
    tree = {"keys": jax.random.split(jax.random.key(3, impl=impl), 5), "x": jnp.arange(4.0)}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, tree, {})
    template = jax.eval_shape(lambda: tree) if shapes_only else tree
    found = checkpoints.restore(1, template)
    assert found["keys"].dtype == tree["keys"].dtype
    np.testing.assert_array_equal(*(jax.random.key_data(keys) for keys in (found["keys"], tree["keys"])))
    np.testing.assert_array_equal(found["x"], tree["x"])


def test_keys_of_another_generator_are_of_another_program(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"key": jax.random.key(3)}, {})
    with pytest.raises(CheckpointError, match="made by another program"):
        checkpoints.restore(1, {"key": jax.random.key(3, impl="rbg")})


@pytest.mark.parametrize("kind", ["file", "dangling link"])
def test_what_is_no_checkpoint_is_in_no_ones_way(kind, tmp_path):
    checkpoints = Checkpoints(tmp_path / "best")
    make = {"file": lambda x: x.write_text("5"), "dangling link": lambda x: x.symlink_to("missing")}
    make[kind](tmp_path / "best" / "3")
    checkpoints.replace(3, {"x": jnp.arange(4.0)}, {})
    np.testing.assert_array_equal(checkpoints.read(3)["x"], np.arange(4.0))
