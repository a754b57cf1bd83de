"""Pairs that are only watched: whoever may touch is stepped by C MuJoCo, and nobody else."""

import functools
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dynamics import mjx
from scipy.spatial.transform import Rotation

from envs.physics import compile_step
from envs.physics.dynamics import forward
from envs.physics.dynamics.bounds import choose_bounds
from envs.physics.dynamics.choice import MOST_CONTACTS, choose_pairs, count_points
from envs.physics.dynamics.solids import list_enclosures, make_solids
from envs.physics.dynamics.watch import Bound, may_touch
from envs.physics.interpreter import trace
from envs.physics.models import put_model
from envs.physics.numeric import evaluate
from envs.physics.pairs import colliding_pairs, find_margin

SHAPES = {
    "sphere": 'type="sphere" size="{0}"',
    "capsule": 'type="capsule" size="{0} {1}"',
    "ellipsoid": 'type="ellipsoid" size="{0} {1} {2}"',
    "cylinder": 'type="cylinder" size="{0} {1}"',
    "box": 'type="box" size="{0} {1} {2}"',
    "mesh": 'type="mesh" mesh="wedge"',
}
MESH = '<asset><mesh name="wedge" vertex="0 0 0 .3 0 0 0 .2 0 0 0 .1 .1 .1 .2"/></asset>'


def floating(geoms, floor=""):
    """Bodies that float, each with these geoms."""
    bodies = "".join(f"<body><freejoint/>{''.join(parts)}</body>" for parts in geoms)
    return mujoco.MjModel.from_xml_string(f"<mujoco>{MESH}<worldbody>{floor}{bodies}</worldbody></mujoco>")


def make_geom(shape, rng, margin=0.0):
    numbers = rng.uniform(0.03, 0.25, 3)
    place = f'pos="{" ".join(map(str, rng.uniform(-0.1, 0.1, 3)))}" quat="{" ".join(map(str, rng.normal(size=4)))}"'
    return f'<geom {SHAPES[shape].format(*numbers)} {place} margin="{margin}" mass="1"/>'


def bound_each(model, pairs):
    """The bound of each pair by the shapes of its geoms."""
    solids = make_solids(model)
    return [Bound(solids[pair.geom1], solids[pair.geom2], find_margin(model, pair)) for pair in pairs]


def compare(model, spread, number=1000, seed=0, bound=bound_each):
    """(ours, true): whether the watched pairs may touch in random states, and whether they do in C MuJoCo."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    mx = put_model(model)
    start, bounds = mjx.make_data(mx), bound(model, colliding_pairs(model))

    def watch(qpos):
        d, _ = forward.find_positions(model, mx, start.replace(qpos=qpos))
        return may_touch(d, bounds)

    qpos = rng.normal(size=(number, model.nbody - 1, 7))
    qpos[:, :, :3] *= spread
    qpos[:, :, 3:] /= np.linalg.norm(qpos[:, :, 3:], axis=2, keepdims=True)
    qpos = qpos.reshape(number, -1)
    (ours,) = evaluate(trace(watch, qpos[0]), [qpos])
    true = np.zeros(number, bool)
    for i in range(number):
        data.qpos[:] = qpos[i]
        mujoco.mj_fwdPosition(model, data)
        true[i] = data.ncon > 0
    return ours, true


@pytest.fixture
def in_float64():
    with jax.enable_x64(True):
        yield


# --- whether they may touch -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("margin", [0.0, 0.05])
@pytest.mark.parametrize("shape", SHAPES)
def test_what_touches_is_flagged(shape, margin, in_float64):
    """Against all shapes. And the bounds are tight: of the flagged states more than a seventh touch."""
    for seed, other in enumerate(SHAPES):
        rng = np.random.default_rng(seed)
        model = floating([[make_geom(shape, rng, margin)], [make_geom(other, rng)]])
        ours, true = compare(model, 0.2, 300)
        assert true.any()
        assert not (true & ~ours).any()
        assert (ours & true).sum() > 0.15 * ours.sum(), other
        assert not ours.all()


@pytest.mark.parametrize("shape", SHAPES)
def test_what_touches_a_plane_is_flagged(shape, in_float64):
    rng = np.random.default_rng(0)
    plane = '<geom type="plane" size="1 1 1" pos="0 0 -.1" quat="1 .2 .3 0"/>'
    ours, true = compare(floating([[make_geom(shape, rng)]], plane), 0.3, 300)
    assert true.any()
    assert not (true & ~ours).any()
    assert (ours & ~true).sum() < (0.2 if shape == "mesh" else 0.02) * ours.sum()


def draw_points(solid, rng, number=500):
    """Points on the surface of a geom, among them the corners of a box."""
    unit = rng.normal(size=(number, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    radius, length = solid.size[:2]
    ends = np.sign(unit[:, 2:]) * [0.0, 0.0, length]
    round_side = unit * [1, 1, 0] / np.linalg.norm(unit[:, :2], axis=1, keepdims=True)
    points = {
        "sphere": radius * unit,
        "capsule": radius * unit + ends,
        "ellipsoid": unit * solid.size,
        "cylinder": radius * round_side + ends,
        "box": np.sign(unit) * solid.size,
        "mesh": np.sign(unit) * solid.size,
    }[solid.shape]
    return solid.middle + points @ solid.axes.T


@pytest.mark.parametrize("number", [1, 2, 4])
def test_enclosures_have_all_of_their_geoms_inside(number):
    rng = np.random.default_rng(number)
    for _ in range(20):
        shapes = rng.choice(list(SHAPES), number)
        solids = make_solids(floating([[make_geom(shape, rng) for shape in shapes]]))
        points = np.concatenate([draw_points(solid, rng) for solid in solids])
        found = list_enclosures(solids)
        assert found[0].shape == "sphere"
        for solid in found:
            beyond = find_depth(solid, points)
            assert beyond.max() < 1e-9, solid
            assert solid.shape != "sphere" or beyond.max() > -0.05 * solid.radius  # and no larger than needed


def find_depth(solid, points):
    """How far points are outside of the capsule around a solid, or of a box; negative inside."""
    offset = points - solid.middle
    share = np.clip(offset @ solid.half / max(solid.half @ solid.half, 1e-30), -1, 1)
    beyond = np.linalg.norm(offset - share[:, None] * solid.half, axis=1) - solid.radius
    if solid.shape == "box":
        return np.maximum(beyond, (np.abs(offset @ solid.axes) - solid.size).max(1))
    return beyond


@pytest.mark.parametrize("seed", range(3))
def test_chosen_bounds_miss_nothing(seed, in_float64):
    """Bodies of geoms of all shapes, above a plane, also where they never were in the simulations."""
    rng = np.random.default_rng(seed)
    bodies = [
        [make_geom(shape, rng, margin=0.02 * (i == 1)) for shape in rng.permutation(list(SHAPES))] for i in (0, 1)
    ]
    model = floating(bodies, '<geom type="plane" size="1 1 1" pos="0 0 -.8"/>')
    ours, true = compare(model, 0.5, bound=choose_bounds)
    assert 0.1 < true.mean() < 0.95
    assert not (true & ~ours).any()
    assert not ours.all()


def test_bounds_of_rows_of_geoms(in_float64):
    """A row of spheres and capsules is one capsule, and one of boxes one box."""
    line = [f'<geom size=".05" pos="0 0 {0.07 * i}"/>' for i in range(6)]
    line += [f'<geom type="capsule" size=".04 .1" pos=".03 0 {0.1 * i}" quat="1 .1 0 0"/>' for i in range(5)]
    check_rows(floating([line, line]))
    box = '<geom type="box" size=".1 .05 .07" pos="{} {} 0" quat="1 .05 -.03 {}"/>'
    row = [box.format(0.1 * i, 0.02 * (i % 2), 0.01 * i) for i in range(9)]
    check_rows(floating([row, row]))


def check_rows(model):
    """Their bounds are few, and neither miss a contact nor say too often that there may be one."""
    pairs = colliding_pairs(model)
    assert len(choose_bounds(model, pairs)) < len(pairs) / 5
    ours, true = compare(model, 0.5, bound=choose_bounds)
    assert true.any()
    assert not (true & ~ours).any()
    assert not ours.all()
    assert (ours & true).sum() > 0.3 * ours.sum()


def test_bodies_that_stay_apart_have_one_bound_of_spheres():
    """And those that come near have bounds that tell a miss from a contact."""
    apart = choose_bounds(*with_pairs(crosses(3.0)))
    assert [(bound.one.shape, bound.other.shape) for bound in apart] == [("sphere", "sphere")]
    near = choose_bounds(*with_pairs(crosses(0.8)))
    assert len(near) > 1
    assert "capsule" in {bound.one.shape for bound in near} | {bound.other.shape for bound in near}


def crosses(distance):
    """Two crosses of capsules at this distance (m), with arms of 0.5 m, that turn in nearly the same plane."""
    capsules = [f'<geom type="capsule" size=".02" fromto="{x} 0 {z} {-x} 0 {-z}"/>' for x, z in ((0.5, 0), (0, 0.5))]
    cross = f'<joint axis="0 1 0"/>{"".join(capsules)}</body>'
    bodies = f'<body>{cross}<body pos="{distance} .03 0">{cross}'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")


def with_pairs(model):
    return model, colliding_pairs(model)


def test_a_pair_that_is_listed_twice_has_one_bound():
    """With the larger margin."""
    text = """<mujoco><worldbody><body><freejoint/><geom name="a" size=".1"/></body><body pos="1 0 0"><freejoint/>
    <geom name="b" size=".1"/></body></worldbody><contact><pair geom1="a" geom2="b" margin=".01"/>
    <pair geom1="b" geom2="a" margin=".02"/></contact></mujoco>"""
    bounds = choose_bounds(*with_pairs(mujoco.MjModel.from_xml_string(text)))
    assert [bound.margin for bound in bounds] == [0.02]


def test_what_is_far_is_not_flagged(in_float64):
    rng = np.random.default_rng(0)
    model = floating([[make_geom(shape, rng)] for shape in SHAPES])
    ours, _ = compare(model, 30.0, 50)
    assert ours.sum() < 3


LONG = (0.3, 0.5, 3.0)  # m, half-lengths of capsules
ROUNDING = 1e-6  # m


def draw_crossings(rng, number, reach):
    """Poses `[number, 3, 7]` of capsules, at angles of 1e-6 to 1e-2 rad or any, whose lines meet within or near them.

    Or come as near as some share of `reach`, across the lines in any direction.
    """
    shape = number, 3
    angle = np.where(rng.random(shape) < 0.9, 10 ** rng.uniform(-6, -2, shape), rng.uniform(0, 3, shape))
    along = rng.uniform(-1.2, 1.2, shape) * LONG
    across = rng.uniform(-1.2, 1.2, (number, 3, 2)) * reach * rng.integers(0, 2, (number, 1, 1))
    frame = Rotation.random(number, rng)
    turned = [frame * Rotation.from_rotvec(np.outer(x, [1.0, 0.0, 0.0])) for x in angle.T]
    middle = [
        each.apply(np.append(x, -z[:, None], 1))
        for each, x, z in zip(turned, across.swapaxes(0, 1), along.T, strict=True)
    ]
    poses = [np.append(x, each.as_quat(scalar_first=True), 1) for x, each in zip(middle, turned, strict=True)]
    return np.stack(poses, 1).astype(np.float32)


@pytest.mark.parametrize("radius", [0.0001, 0.002, 0.05])
def test_nearly_parallel_capsules_are_flagged(radius):
    """In single precision: who is nearer than the margin by C MuJoCo's distance is flagged, and few others."""
    model = floating([[f'<geom type="capsule" size="{radius} {x}" margin="1e-4" mass="1"/>'] for x in LONG])
    data, mx = mujoco.MjData(model), put_model(model)
    start, pairs = mjx.make_data(mx), colliding_pairs(model)
    margin = find_margin(model, pairs[0])

    def watch(qpos):
        d, _ = forward.find_positions(model, mx, start.replace(qpos=qpos))
        return jnp.stack([may_touch(d, [each]) for each in bound_each(model, pairs)])

    qpos = draw_crossings(np.random.default_rng(0), 3000, 2 * radius + margin)
    (ours,) = evaluate(trace(watch, qpos[0].ravel()), [qpos.reshape(len(qpos), -1)])
    distance = np.zeros((len(qpos), len(pairs)))
    for i, each in enumerate(qpos):
        data.qpos[:] = each.ravel()
        mujoco.mj_kinematics(model, data)
        distance[i] = [mujoco.mj_geomDistance(model, data, pair.geom1, pair.geom2, 1.0, None) for pair in pairs]
    near = distance < margin - ROUNDING
    assert 0.1 < near.mean() < 0.9
    assert not (near & ~ours).any()
    assert not (ours & (distance > margin + 0.005)).any()


# --- which pairs are watched ------------------------------------------------------------------------------------------

PLANE = '<geom name="floor" type="plane" size="5 5 1"/>'


def arms(options="", floor="", more=""):
    """Two arms of two links, which meet if they bend towards each other."""
    arm = """<body name="{0}" pos="{1} 0 1"><joint axis="0 1 0" range="-3 3" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 0 0 .4" size=".04"/><body pos="0 0 .45"><joint axis="0 1 .1" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0 0 .3" size=".04"/></body></body>"""
    text = f"""<mujoco model="two arms"><compiler autolimits="true" angle="radian"/><option timestep=".005" {options}/>
    <worldbody>{floor}{arm.format("a", -0.4)}{arm.format("b", 0.4)}{more}</worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def test_what_never_touches_by_itself_is_watched():
    """And the contact of a free ball with the floor is written out, as is what touches while nothing is commanded."""
    model = arms(floor=PLANE, more='<body pos="2 0 9"><freejoint/><geom name="ball" size=".1"/></body>')
    pairs = colliding_pairs(model)
    chosen, watched = choose_pairs(model, pairs)
    assert [(pair.geom1, pair.geom2) for pair in chosen] == [(model.geom("floor").id, model.geom("ball").id)]
    assert set(chosen) | set(watched) == set(pairs)
    assert not set(chosen) & set(watched)
    assert len(watched) == 12
    box = '<body pos="2 0 {}"><freejoint/><geom name="{}" type="box" size=".2 .2 .1"/></body>'
    stacked = arms(floor=PLANE, more=box.format(0.1, "low") + box.format(0.299, "high"))
    touching = {(stacked.geom("low").id, stacked.geom("high").id)}
    assert touching <= {(pair.geom1, pair.geom2) for pair in choose_pairs(stacked, colliding_pairs(stacked))[0]}


@pytest.mark.parametrize(
    ("joint", "gravity", "is_chosen"),
    [
        ('type="free"', 0, True),
        ('type="slide" axis="1 0 0"', 0, True),
        ('type="slide" axis="1 0 0" range="-.1 .1"', 0, False),
        ('type="hinge" axis="0 1 0"', 0, False),
        ('type="hinge" axis="0 1 0"', -10, True),
    ],
)
def test_planes_of_robots_on_a_base(joint, gravity, is_chosen):
    """Who stays on a base gets the contact with the plane only if it touches it, here as it falls on it."""
    link = f'<body pos="0 0 .2"><joint {joint}/><geom type="capsule" fromto="0 0 0 .4 0 .1" size=".04"/></body>'
    text = f'<mujoco><option gravity="0 0 {gravity}"/><worldbody>{PLANE}{link}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    pairs = colliding_pairs(model)
    assert len(pairs) == 1
    assert choose_pairs(model, pairs) == ((pairs, []) if is_chosen else ([], pairs))


def make_gripper(place, geoms):
    """Two fingers at this distance (m) from the middle, which servos close by up to 4 cm each."""
    finger = f'<joint name="{{0}}" type="slide" axis="{{1}} 0 0" range="0 .04"/>{geoms}</body>'
    fingers = f'<body pos="-{place} 0 0">{finger.format("l", 1)}<body pos="{place} 0 0">{finger.format("r", -1)}'
    servo = '<position joint="{}" kp="1" kv=".3" ctrlrange="0 .04"/>'
    return mujoco.MjModel.from_xml_string(f"""<mujoco><compiler autolimits="true"/><option gravity="0 0 0"/>
    <worldbody>{fingers}</worldbody><actuator>{servo.format("l")}{servo.format("r")}</actuator></mujoco>""")


@pytest.mark.parametrize(
    ("place", "shape", "is_chosen"),
    [
        (0.02, 'size=".01"', True),
        (0.044, 'size=".01"', False),
        (0.05, 'size=".01"', False),
        (0.02, 'type="box" size=".01 .01 .01"', False),
    ],
)
def test_fingers_that_close_under_commands_are_chosen(place, shape, is_chosen):
    """Not if they touch in 2 % of the steps or never do, and not as boxes, whose contact costs much."""
    model = make_gripper(place, f"<geom {shape}/>")
    pairs = colliding_pairs(model)
    assert len(pairs) == 1
    assert choose_pairs(model, pairs) == ((pairs, []) if is_chosen else ([], pairs))


def test_fingers_that_meet_are_chosen_with_all_their_geoms():
    """The second spheres never touch in the simulations, but they are cheap, and near."""
    spheres = '<geom size=".01"/><geom size=".004" pos="0 0 .02"/>'
    model = make_gripper(0.02, spheres)
    pairs = [pair for pair in colliding_pairs(model) if pair.geom2 - pair.geom1 == 2]
    assert len(pairs) == 2
    assert choose_pairs(model, pairs) == (pairs, [])
    assert choose_pairs(model, pairs[1:]) == ([], pairs[1:])


def test_simulations_that_diverge_say_nothing(tmp_path, monkeypatch, capfd):
    """What C MuJoCo does after a restart is not counted, and it neither prints its warning nor writes a file of it."""
    monkeypatch.chdir(tmp_path)
    joint = '<joint axis="0 1 0" range="-9 9" damping="-99"/>'
    link = f'<body pos="0 0 .3">{joint}<geom type="capsule" fromto="0 0 0 .4 0 .1" size=".04"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{PLANE}{link}</worldbody></mujoco>")
    choose_pairs(model, colliding_pairs(model))
    assert list(tmp_path.iterdir()) == []
    assert "".join(capfd.readouterr()) == ""


def test_contacts_are_bounded():
    boxes = "".join(f'<body pos="{i} 0 .1"><freejoint/><geom type="box" size=".2 .2 .1"/></body>' for i in range(20))
    model = arms(floor=PLANE, more=boxes)
    chosen, watched = choose_pairs(model, colliding_pairs(model))
    assert 0 < count_points(model, chosen) <= MOST_CONTACTS
    assert len(chosen) + len(watched) == len(colliding_pairs(model))


def test_varying_shapes_cannot_be_watched():
    model = arms()
    pairs = colliding_pairs(model)
    assert choose_pairs(model, pairs, ("geom_size",)) == (pairs, [])


# --- steps ------------------------------------------------------------------------------------------------------------

SUBSTEPS = 3


def draw_states(number=200, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (number, 4)).astype(np.float32), rng.uniform(-3, 3, (number, 4)).astype(np.float32)


@functools.cache
def make_step(physics="scalar", substeps=SUBSTEPS):
    step = compile_step(arms(), substeps, inputs=("qpos", "qvel"), physics=physics)
    return step, jax.jit(jax.vmap(step))


@functools.cache
def step_by_mujoco(seed=0):
    """(qpos, qvel, touched): by C MuJoCo's loop, with whether there was a contact in one of the substeps."""
    model, results = arms(), []
    data = mujoco.MjData(model)
    for qpos, qvel in zip(*draw_states(seed=seed), strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], touched = qpos, qvel, False
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
            touched |= data.ncon > 0
        results.append((data.qpos.copy(), data.qvel.copy(), touched))
    return tuple(map(np.array, zip(*results, strict=True)))


def close(ours, true):
    for mine, other in zip(ours, true, strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-3, atol=1e-3)


def test_everyone_is_stepped_as_by_mujoco():
    qpos, qvel, touched = step_by_mujoco()
    assert 10 < touched.sum() < 150
    ours = make_step()[1](*draw_states())
    close(ours, (qpos, qvel))
    floor = make_step("mujoco")[1](*draw_states())
    for mine, other in zip(ours, floor, strict=True):  # those that touch come from C MuJoCo itself, to the bit
        np.testing.assert_array_equal(mine[touched], other[touched])
    same = np.all([(np.asarray(mine) == other).all(1) for mine, other in zip(ours, floor, strict=True)], 0)
    assert 0 < (~same).sum() <= (~touched).sum()  # the others by the equations


def test_environments_do_not_influence_each_other():
    """In another order, and among others that are far from touching."""
    states = draw_states()
    together, order = make_step()[1](*states), np.random.default_rng(1).permutation(200)
    moved = make_step()[1](*(x[order] for x in states))
    for mine, other in zip(together, moved, strict=True):
        np.testing.assert_array_equal(np.asarray(mine)[order], other)
    single = make_step()[0]
    for place in (0, 1, np.flatnonzero(step_by_mujoco()[2])[0]):
        close(jax.jit(single)(*(x[place] for x in states)), [x[place] for x in together])


def test_a_nan_stays_in_its_environment():
    states = draw_states()
    sound = make_step()[1](*states)
    touched = np.flatnonzero(step_by_mujoco()[2])[0]
    for place in (touched, np.flatnonzero(~step_by_mujoco()[2])[0]):
        bad = [x.copy() for x in states]
        bad[0][place, 1] = np.nan
        results = [np.asarray(x) for x in make_step()[1](*bad)]
        assert all(np.isnan(x[place]).any() for x in results)
        for mine, other in zip(results, sound, strict=True):
            np.testing.assert_array_equal(np.delete(mine, place, 0), np.delete(other, place, 0))


def test_inside_scans_and_several_maps():
    step, batched = make_step()
    qpos, qvel = draw_states()
    expected = batched(*batched(qpos, qvel))

    @jax.jit
    def play(state):
        return jax.lax.scan(lambda state, _: (batched(*state), None), state, length=2)[0]

    close(play((qpos, qvel)), expected)
    split = [x.reshape(4, 50, 4) for x in (qpos, qvel)]
    folded = jax.jit(jax.vmap(jax.vmap(step)))(*split)
    close([x.reshape(200, 4) for x in folded], batched(qpos, qvel))


def test_derivatives_where_nothing_touches():
    """Against differences of the step in float64, as if the arms could not touch."""
    qpos, qvel = (x[~step_by_mujoco()[2]][:3] for x in draw_states())
    with jax.enable_x64(True):
        step = compile_step(arms(), 1, inputs=("qpos", "qvel"))
        derivative = jax.jit(jax.vmap(jax.jacfwd(lambda *x: step(*x)[1], (0, 1))))(
            qpos.astype(float), qvel.astype(float)
        )
        jit = jax.jit(jax.vmap(step))
        for argument, mine in enumerate(derivative):
            for i, e in enumerate(1e-6 * np.eye(4)):
                ahead, back = ([qpos.astype(float), qvel.astype(float)] for _ in range(2))
                ahead[argument], back[argument] = ahead[argument] + e, back[argument] - e
                true = (jit(*ahead)[1] - jit(*back)[1]) / 2e-6
                np.testing.assert_allclose(mine[:, :, i], true, rtol=1e-4, atol=1e-4)


DEVICES = """
import jax, jax.numpy as jnp, numpy as np, sys
jax.config.update("jax_num_cpu_devices", 2)
sys.path.insert(0, {folder!r})
from test_watch import arms, draw_states
from envs.physics import compile_step
step = jax.vmap(compile_step(arms(), 3, inputs=("qpos", "qvel")))
mesh = jax.sharding.Mesh(jax.devices(), ("shards",))
def play(state):
    return jax.lax.scan(lambda state, _: (tuple(step(*state)), None), state, length=20)[0]
where = jax.sharding.PartitionSpec("shards")
state = tuple(jnp.tile(x, (200, 1)) for x in draw_states())
shards = jax.jit(jax.shard_map(play, mesh=mesh, in_specs=where, out_specs=where, check_vma=False))
one, other = shards(state), shards(state)
print(all(np.array_equal(a, b) for a, b in zip(one, other)), np.isfinite(one[0]).all())
"""


def test_two_devices():
    """40,000 environments, twenty steps: ends, with the same bits."""
    code = DEVICES.format(folder=str(Path(__file__).parent))
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200, check=False)
    assert ended.stdout == "True True\n", ended.stderr
