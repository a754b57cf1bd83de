"""Programs that would be too long leave the rarest contacts to C MuJoCo, or say what is too much."""

import jax
import mujoco
import numpy as np
import pytest

from envs.physics import compile_step, describe, scalar
from envs.physics.dynamics import division
from envs.physics.dynamics.choice import choose_pairs, drop_rarest
from envs.physics.dynamics.program import trace_step
from envs.physics.pairs import colliding_pairs

INPUTS = ("qpos", "qvel")
HEIGHTS = (0.1, 0.6, 30.0)  # of balls of 0.1 m: one lies on the floor, one falls on it after 0.32 s, one does not


def make_balls():
    ball = '<body pos="{} 0 {}"><freejoint/><geom size=".1" solref=".01 1" contype="1" conaffinity="2"/></body>'
    bodies = "".join(ball.format(i, height) for i, height in enumerate(HEIGHTS))
    floor = '<geom name="floor" type="plane" size="9 9 1" contype="2"/>'
    return mujoco.MjModel.from_xml_string(
        f'<mujoco model="balls"><option timestep=".005"/><worldbody>{floor}{bodies}</worldbody></mujoco>'
    )


def count_equations(model):
    """(without contacts, with all of them)."""
    apart = make_balls()
    apart.geom_contype[:] = apart.geom_conaffinity[:] = 0
    return [len(trace_step(each, INPUTS, INPUTS)) for each in (apart, model)]


def limit(monkeypatch, number):
    """Programs have at most so many equations, and none is remembered."""
    monkeypatch.setattr(division, "LARGEST_PROGRAM", number)
    monkeypatch.setattr(scalar, "_latest", {})


@pytest.mark.parametrize(("share", "kept"), [(0.0, 2), (0.3, 2), (0.4, 1), (0.6, 1), (0.7, 0), (1.0, 0)])
def test_what_touches_least_is_dropped_first(share, kept):
    """Each contact has a third of the equations; the balls that stay are those that touch longest."""
    model = make_balls()
    pairs, _ = choose_pairs(model, colliding_pairs(model))
    assert [pair.geom2 for pair in pairs] == [1, 2, 3]
    for order in (pairs, pairs[::-1]):
        left, dropped = drop_rarest(model, order, share)
        assert sorted(pair.geom2 for pair in left) == [1, 2, 3][:kept]
        assert set(left) | set(dropped) == set(pairs)


@pytest.mark.parametrize("kept", [0, 1, 2])
def test_too_many_contacts_are_left_to_c_mujoco(kept, monkeypatch):
    model = make_balls()
    own, whole = count_equations(model)
    most = int(own + (kept + 0.7) / 3 * (whole - own))
    limit(monkeypatch, most)
    program = trace_step(model, INPUTS, INPUTS)
    assert own < len(program) <= most
    assert len(program.outputs) == len(INPUTS) + 1  # with the flag


def test_motion_with_contacts_left_out(monkeypatch):
    """It is C MuJoCo's, with contacts by the equations and by C MuJoCo."""
    model = make_balls()
    own, whole = count_equations(model)
    limit(monkeypatch, (own + whole) // 2)
    step = jax.jit(compile_step(model, inputs=INPUTS, outputs=INPUTS))
    data = mujoco.MjData(model)
    state = data.qpos.astype(np.float32), data.qvel.astype(np.float32)
    for _ in range(100):
        state = step(*state)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(state[0], data.qpos, atol=2e-4)
    assert data.qpos[9] < 0.15


def test_the_reason_says_what_the_equations_are_for(monkeypatch):
    model = make_balls()
    own, whole = count_equations(model)
    limit(monkeypatch, own - 1)
    reason = describe(model, INPUTS, INPUTS).reason
    assert f"{whole:,} equations" in reason
    assert f"{own:,} are its own and {whole - own:,} those of contacts" in reason
    assert "leave out bodies" in reason
    limit(monkeypatch, own)  # fits only without watching
    reason = describe(model, INPUTS, INPUTS).reason
    assert f"{own:,} are its own" in reason
    assert "the 3 pairs of geoms" in reason


def test_shapes_that_vary_are_not_watched(monkeypatch):
    model = make_balls()
    inputs = (*INPUTS, "model.geom_size")
    number = len(trace_step(model, inputs, INPUTS))
    limit(monkeypatch, number - 1)
    assert f"{number:,} equations" in describe(model, inputs, INPUTS).reason
