"""The robots of envs/assets: their makers' figures, by plain float64, and a motion that is C MuJoCo's."""

import logging

import mujoco
import numpy as np
import pytest

from envs.base import ASSETS
from envs.physics import candidate_pairs, check_model, compile_model, describe, load_spec
from envs.physics.models import find_control_ranges

ROBOTS = ("panda", "ur5e", "so100", "quadruped", "drive")
EQUATIONS = {
    "panda": 3500,
    "ur5e": 3500,
    "so100": 3200,
    "quadruped": 17_000,
    "drive": 3500,
}  # at most: a model that grows shows here


def load(name):
    return compile_model(load_spec(ASSETS / f"{name}.xml"))


def at_home(model):
    """C MuJoCo's data at the keyframe."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return data


# --- all of them ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ROBOTS)
def test_steps_are_scalar_equations(name, caplog):
    """Few enough of them, nothing is left to C MuJoCo, and nothing is warned of."""
    with caplog.at_level(logging.WARNING):
        found = describe(load(name))
    assert (found.name, found.physics, found.meshes) == (name, "scalar", 0)
    assert 0 < found.equations < EQUATIONS[name]
    assert not caplog.records


@pytest.mark.parametrize("name", ROBOTS)
def test_the_motion_is_c_mujocos(name):
    assert check_model(load(name)) == []


@pytest.mark.parametrize("name", ROBOTS)
def test_home_is_within_all_limits_and_free_of_contacts_of_the_robot_with_itself(name):
    model = load(name)
    data = at_home(model)
    joints = model.jnt_limited > 0
    qpos = data.qpos[model.jnt_qposadr[joints]]
    assert (model.jnt_range[joints, 0] <= qpos).all()
    assert (qpos <= model.jnt_range[joints, 1]).all()
    low, high = find_control_ranges(model)
    assert (low <= data.ctrl).all()
    assert (data.ctrl <= high).all()
    for contact in data.contact:
        assert 0 in model.geom_bodyid[contact.geom]


# --- arms -------------------------------------------------------------------------------------------------------------


def turn(axis, angle):
    """The homogeneous matrix of a rotation about the x (0) or z axis (2)."""
    matrix = np.eye(4)
    i, j = [k for k in range(3) if k != axis]
    matrix[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return matrix


def move(x=0.0, z=0.0):
    matrix = np.eye(4)
    matrix[:3, 3] = x, 0, z
    return matrix


QUARTER = np.pi / 2
# Rows of (d, a, alpha) for each joint, in metres and radians.
UR5E = [
    (0.1625, 0, QUARTER),
    (0, -0.425, 0),
    (0, -0.3922, 0),
    (0.1333, 0, QUARTER),
    (0.0997, 0, -QUARTER),
    (0.0996, 0, 0),
]
PANDA = [  # a and alpha are those of the frame before, as in Craig's convention
    (0.333, 0, 0),
    (0, 0, -QUARTER),
    (0.316, 0, QUARTER),
    (0, 0.0825, QUARTER),
    (0.384, -0.0825, -QUARTER),
    (0, 0, QUARTER),
    (0, 0.088, QUARTER),
]
UR5E_MASSES = [3.761, 8.058, 2.846, 1.37, 1.3, 0.365]  # kg
UR5E_CENTRES = [  # m, in the frames at the ends of the links
    (0, -0.02561, 0.00193),
    (0.2125, 0, 0.11336),
    (0.15, 0, 0.0265),
    (0, -0.0018, 0.01634),
    (0, 0.0018, 0.01634),
    (0, 0, -0.001159),
]
UR5E_INERTIAS = [  # xx, xy, xz, yy, yz, zz [kg m^2]
    (0.00700210, 0.00000073, -0.00001053, 0.00648091, 0.00049994, 0.00657286),
    (0.01505885, -0.00005400, 0.00000563, 0.33388086, -0.00000181, 0.33247207),
    (0.00399632, -0.00001365, 0.00137272, 0.07879254, -0.00000660, 0.07848510),
    (0.00165491, -0.00000282, -0.00000438, 0.00135962, 0.00010157, 0.00126279),
    (0.00135617, -0.00000274, 0.00000444, 0.00127827, -0.00005048, 0.00096614),
    (0.00018694, 0.00000006, -0.00000017, 0.00018908, -0.00000092, 0.00025756),
]


def place_ur5e(qpos):
    """T_i = T_(i-1) Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i), from a base that is turned by 180 degrees."""
    frames = [turn(2, np.pi)]
    for angle, (d, a, alpha) in zip(qpos, UR5E, strict=True):
        frames.append(frames[-1] @ turn(2, angle) @ move(z=d) @ move(x=a) @ turn(0, alpha))
    return frames[1:]


def place_panda(qpos):
    """T_i = T_(i-1) Rx(alpha_(i-1)) Tx(a_(i-1)) Rz(q_i) Tz(d_i)."""
    frames = [np.eye(4)]
    for angle, (d, a, alpha) in zip(qpos, PANDA, strict=True):
        frames.append(frames[-1] @ turn(0, alpha) @ move(x=a) @ turn(2, angle) @ move(z=d))
    return frames[1:]


@pytest.mark.parametrize(("name", "place", "flange"), [("panda", place_panda, 0.107), ("ur5e", place_ur5e, 0.0)])
def test_frames_are_those_of_the_denavit_hartenberg_figures(name, place, flange):
    model = load(name)
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = random.uniform(*model.jnt_range.T)
        mujoco.mj_kinematics(model, data)
        frames = place(data.qpos)
        for i, frame in enumerate(frames):
            body = data.body(f"link{i + 1}")
            np.testing.assert_allclose(body.xpos, frame[:3, 3], atol=1e-9)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), frame[:3, :3], atol=1e-9)
        tool = frames[-1] @ move(z=flange)
        np.testing.assert_allclose(data.site("flange").xpos, tool[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.site("flange").xmat.reshape(3, 3), tool[:3, :3], atol=1e-9)


def potential_energy(qpos):
    """V = g sum_i m_i z_i [J] of the UR5e, from the maker's masses and centres."""
    frames = place_ur5e(qpos)
    heights = [(frame @ [*centre, 1.0])[2] for frame, centre in zip(frames, UR5E_CENTRES, strict=True)]
    return 9.81 * np.dot(UR5E_MASSES, heights)


def test_torques_that_hold_the_ur5e_are_the_derivatives_of_its_potential_energy():
    model = load("ur5e")
    data, random = mujoco.MjData(model), np.random.default_rng(1)
    for _ in range(10):
        data.qpos[:] = random.uniform(*model.jnt_range.T)
        mujoco.mj_forward(model, data)
        steps = 1e-5 * np.eye(6)
        forces = [(potential_energy(data.qpos + h) - potential_energy(data.qpos - h)) / 2e-5 for h in steps]
        np.testing.assert_allclose(data.qfrc_bias, forces, atol=1e-6)


def test_inertias_of_the_ur5e_are_the_makers():
    model = load("ur5e")
    for i, (xx, xy, xz, yy, yz, zz) in enumerate(UR5E_INERTIAS):
        body = model.body(f"link{i + 1}")
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, body.iquat)
        axes = rotation.reshape(3, 3)
        true = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        np.testing.assert_allclose(axes * body.inertia @ axes.T, true, atol=1e-9)
        assert body.mass == UR5E_MASSES[i]


def test_limits_of_the_ur5e_are_the_makers():
    model = load("ur5e")
    turns = np.pi * np.array([2, 2, 1, 2, 2, 2])
    np.testing.assert_allclose(model.jnt_range, np.stack([-turns, turns], 1), atol=1e-8)
    assert model.actuator_ctrlrange[:, 1].tolist() == [150, 150, 150, 28, 28, 28]
    np.testing.assert_allclose(model.numeric("velocity_limit").data, np.pi, atol=1e-8)


def test_the_tool_of_the_ur5e_points_down_in_front_of_it_at_home():
    model = load("ur5e")
    data = at_home(model)
    np.testing.assert_allclose(data.site("flange").xmat.reshape(3, 3)[:, 2], [0, 0, -1], atol=1e-7)
    assert data.site("flange").xpos[0] > 0.4
    assert 0.2 < data.site("flange").xpos[2] < 0.6


@pytest.mark.parametrize(
    ("qpos", "touching"),
    [
        ((0, -1.57, 2.9, 0, 0, 0), "link1"),  # folded: the wrist at the shoulder
        ((0, 1.57, 0, 0, 0, 0), ""),  # hanging: the upper arm beside the base
        ((0, -1.57, 0, -1.57, 0, 0), ""),  # upright
    ],
)
def test_the_ur5e_meets_itself_where_it_is_folded(qpos, touching):
    model = load("ur5e")
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    names = {model.geom(g).name for contact in data.contact for g in contact.geom}
    assert (touching in names) if touching else not names


# --- SO-100 -----------------------------------------------------------------------------------------------------------

# The makers' URDF: origin [m] and roll, pitch, yaw [rad] of each joint, its axis, in our direction, and our angle at
# their 0.
SO100 = [
    ((0, -0.0452, 0.0165), (1.57079, 0, 0), (0, 1, 0), 0),
    ((0, 0.1025, 0.0306), (-1.8, 0, 0), (1, 0, 0), -1.8),
    ((0, 0.11257, 0.028), (1.57079, 0, 0), (1, 0, 0), QUARTER),
    ((0, 0.0052, 0.1349), (-1, 0, 0), (1, 0, 0), QUARTER - 1),
    ((0, -0.0601, 0), (0, 1.57079, 0), (0, -1, 0), 0),
    ((-0.0202, -0.0244, 0), (0, 3.14158, 0), (0, 0, 1), 0),
]
SO100_BODIES = ("shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw")
# kg, m, and xx, yy, zz [kg m^2], in the frames of the URDF
SO100_LINKS = [
    (0.119226, (-9.07886e-05, 0.0590972, 0.031089), (5.94278e-05, 5.89975e-05, 3.13712e-05)),
    (0.162409, (-1.72052e-05, 0.0701802, 0.00310545), (0.000213312, 0.000167164, 7.01522e-05)),
    (0.147968, (-0.00339604, 0.00137796, 0.0768007), (0.000138803, 0.000107748, 4.84242e-05)),
    (0.0661321, (-0.00852653, -0.0352279, -2.34622e-05), (3.45403e-05, 2.39041e-05, 1.94704e-05)),
    (0.0929859, (0.00552377, -0.0280167, 0.000483583), (5.03136e-05, 4.64098e-05, 2.72961e-05)),
    (0.0202444, (-0.00161745, -0.0303473, 0.000449646), (1.11265e-05, 8.99651e-06, 2.99548e-06)),
]


def about(axis, angle):
    """The rotation about a unit vector, by Rodrigues' formula."""
    K = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def place_so100(qpos):
    """Places and rotations of the links' frames as in the URDF, which is turned to face +x."""
    rotation, place, frames = about((0, 0, 1), QUARTER), np.zeros(3), []
    for angle, (origin, (roll, pitch, yaw), axis, zero) in zip(qpos, SO100, strict=True):
        place = place + rotation @ origin
        fixed = about((0, 0, 1), yaw) @ about((0, 1, 0), pitch) @ about((1, 0, 0), roll)
        rotation = rotation @ fixed @ about(axis, angle - zero)
        frames.append((place, rotation))
    return frames


def test_the_so100_is_that_of_the_makers_urdf():
    """Joints, centres of mass and inertias, of which those angles are written to 1e-5."""
    model = load("so100")
    data, random = mujoco.MjData(model), np.random.default_rng(2)
    for _ in range(20):
        data.qpos[:] = random.uniform(*model.jnt_range.T)
        mujoco.mj_kinematics(model, data)
        frames = place_so100(data.qpos)
        for name, (place, rotation), (mass, centre, inertia) in zip(SO100_BODIES, frames, SO100_LINKS, strict=True):
            body, axes = data.body(name), data.body(name).ximat.reshape(3, 3)
            np.testing.assert_allclose(body.xpos, place, atol=1e-5)
            np.testing.assert_allclose(body.xipos, place + rotation @ centre, atol=1e-5)
            mine, true = axes * model.body(name).inertia @ axes.T, rotation * inertia @ rotation.T
            np.testing.assert_allclose(mine, true, atol=1e-8)
            assert model.body(name).mass == mass
        place, rotation = frames[4]
        tip = place + rotation @ (-0.0079, -0.0981, 0)
        np.testing.assert_allclose(data.site("tip").xpos, tip, atol=1e-5)


def test_the_ranges_of_the_so100_are_the_makers():
    ranges = [(-2, 2), (0, 3.5), (-3.14158, 0), (-2.5, 1.2), (-3.14158, 3.14158), (-0.2, 2)]
    zeros = np.array([zero for *_, zero in SO100])
    np.testing.assert_allclose(load("so100").jnt_range, ranges + zeros[:, None], atol=1e-4)


def test_servos_of_the_so100_turn_as_fast_as_in_their_data_sheet():
    """Without load 52 rpm = 5.45 rad/s, where the stall torque of 1.91 N m meets friction and damping."""
    model = load("so100")
    model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    data.joint("roll").qpos = -3
    data.actuator("roll").ctrl = 3
    speeds, torques = [], []
    for _ in range(300):
        mujoco.mj_step(model, data)
        speeds.append(data.joint("roll").qvel[0])
        torques.append(data.actuator("roll").force[0])
    assert max(torques) == 1.91
    np.testing.assert_allclose(max(speeds), 52 * 2 * np.pi / 60, rtol=0.005)


def test_the_so100_holds_its_place_at_home():
    """But for what its weight bends the servos: gravity's torque by their stiffness, 18.8 N m/rad."""
    model = load("so100")
    data = at_home(model)
    sag = np.abs(data.qfrc_bias) / 18.8
    home = data.qpos.copy()
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() < 1e-3
    assert (np.abs(data.qpos - home) <= 1.05 * sag + 0.0515 / 18.8).all()
    np.testing.assert_allclose(data.site("tip").xmat.reshape(3, 3)[:, 0], [0, 0, -1], atol=0.05)  # it points down


# --- quadruped --------------------------------------------------------------------------------------------------------

# The maker's URDF. Of the front left leg: kg, m, and xx, xy, xz, yy, yz, zz [kg m^2] about the centre of mass
GO1_TRUNK = (5.204, (0.0223, 0.002, -0.0005))
GO1_IMU = (0.001, (-0.01592, -0.06659, -0.00617))
GO1_HIP = (
    0.591,
    (-0.00541, -0.00074, 6e-06),
    (0.000374268192, 3.6844422e-05, -9.86754e-07, 0.000635923669, -1.172894e-06, 0.000457647394),
)
GO1_THIGH = (
    0.92,
    (-0.003468, -0.018947, -0.032736),
    (0.005851561134, 1.783284e-06, 0.000328291374, 0.005596155105, 2.1430713e-05, 0.00107157026),
)
GO1_CALF = (
    0.131,
    (0.006286, 0.001307, -0.122269),
    (0.002939186297, 1.440899e-06, -0.00010535955, 0.00295576935, -2.4397752e-05, 3.0273372e-05),
)
GO1_FOOT = (0.06, (0, 0, -0.213), (9.6e-06, 0, 0, 9.6e-06, 0, 9.6e-06))
LEGS = {"fr": (1, -1), "fl": (1, 1), "rr": (-1, -1), "rl": (-1, 1)}  # signs of x and y
LINK = 0.213  # m, of thigh and calf


def as_matrix(xx, xy, xz, yy, yz, zz):
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def join(parts):
    """Mass, centre of mass and inertia about it of several bodies, by the parallel axis theorem."""
    mass = sum(m for m, *_ in parts)
    centre = sum(m * np.array(c) for m, c, *_ in parts) / mass
    inertia = np.zeros((3, 3))
    for m, c, i in parts:
        r = np.array(c) - centre
        inertia += as_matrix(*i) + m * (r @ r * np.eye(3) - np.outer(r, r))
    return mass, centre, inertia


def mirror(part, x, y):
    """A part of the front left leg on another leg."""
    mass, centre, inertia = join([part])
    signs = np.diag([x, y, 1])
    return mass, signs @ centre, signs @ inertia @ signs


def place_foot(qpos, x, y):
    """corner + Rx(q1) (side + Ry(q2) (thigh + Ry(q3) calf)), in the frame of the trunk."""
    abduction, hip, knee = qpos
    down = np.array([0, 0, -LINK])
    leg = about((0, 1, 0), hip) @ (down + about((0, 1, 0), knee) @ down)
    side, corner = np.array([0, 0.08 * y, 0]), np.array([0.1881 * x, 0.04675 * y, 0])
    return corner + about((1, 0, 0), abduction) @ (side + leg)


def test_the_feet_of_the_quadruped_are_where_the_makers_lengths_place_them():
    model = load("quadruped")
    data, random = mujoco.MjData(model), np.random.default_rng(3)
    for _ in range(20):
        data.qpos[7:] = random.uniform(*model.jnt_range[1:].T)
        mujoco.mj_kinematics(model, data)
        for number, (leg, signs) in enumerate(LEGS.items()):
            foot = place_foot(data.qpos[7 + 3 * number : 10 + 3 * number], *signs)
            np.testing.assert_allclose(data.site(f"{leg}_foot").xpos, data.body("trunk").xpos + foot, atol=1e-9)
            np.testing.assert_allclose(data.geom(f"{leg}_foot").xpos, data.site(f"{leg}_foot").xpos, atol=1e-9)


def test_masses_and_inertias_of_the_quadruped_are_the_makers():
    """Of all links; calf and foot are one body, as are trunk and IMU."""
    model = load("quadruped")
    np.testing.assert_allclose(model.body_mass.sum(), 5.205 + 4 * (0.591 + 0.92 + 0.131 + 0.06))
    trunk = sum(m * np.array(c) for m, c in (GO1_TRUNK, GO1_IMU)) / 5.205
    np.testing.assert_allclose(model.body("trunk").ipos, trunk, atol=1e-6)
    for leg, (x, y) in LEGS.items():
        links = {"hip": mirror(GO1_HIP, x, y), "thigh": mirror(GO1_THIGH, 1, y), "calf": join([GO1_CALF, GO1_FOOT])}
        for name, (mass, centre, inertia) in links.items():
            body, rotation = model.body(f"{leg}_{name}"), np.zeros(9)
            mujoco.mju_quat2Mat(rotation, body.iquat)
            axes = rotation.reshape(3, 3)
            np.testing.assert_allclose(body.mass, mass)
            np.testing.assert_allclose(body.ipos, centre, atol=1e-6)
            np.testing.assert_allclose(axes * body.inertia @ axes.T, inertia, atol=1e-8)


def test_limits_of_the_quadruped_are_the_makers():
    model = load("quadruped")
    ranges = np.tile([(-1.0471975512, 1.0471975512), (-0.663225, 2.967060), (-2.722714, -0.837758)], (4, 1))
    np.testing.assert_allclose(model.jnt_range[1:], ranges, atol=1e-5)
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], np.tile([23.7, 23.7, 23.7 * 1.5], 4))
    motor = 1.118e-4 * 6.33**2
    np.testing.assert_allclose(model.dof_armature[6:], np.tile([motor, motor, motor * 1.5**2], 4), rtol=1e-3)


def test_the_quadruped_stands():
    """For 2 s within 5 mm and 0.01 rad of the keyframe, and the knees bear what the weight asks of them.

    A quarter F of the weight at a foot below the hip bends the knee by F l sin(0.9), less what the calf weighs.
    """
    model = load("quadruped")
    data = at_home(model)
    home = data.qpos.copy()
    for _ in range(round(2 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qpos[:3], home[:3], atol=5e-3)
        np.testing.assert_allclose(data.qpos[3:], home[3:], atol=1e-2)
    assert np.abs(data.qvel).max() < 0.05
    mass, centre, _ = join([GO1_CALF, GO1_FOOT])
    calf = centre[0] * np.cos(0.9) - centre[2] * np.sin(0.9)  # m, of its centre before the knee
    torque = 9.81 * (model.body_mass.sum() / 4 * LINK * np.sin(0.9) - mass * calf)
    np.testing.assert_allclose(data.actuator_force[2::3].mean(), torque, rtol=0.01)


@pytest.mark.parametrize(("quat", "height"), [((0, 1, 0, 0), 0.057), ((1, 1, 0, 0), 0.09), ((1, 0, 1, 0), 0.19)])
def test_a_quadruped_that_falls_lies_on_its_trunk(quat, height):
    """On its back, on its side; on its tail it stands, or has fallen from there."""
    model = load("quadruped")
    data = at_home(model)
    data.qpos[2], data.qpos[3:7] = height + 0.05, np.array(quat) / np.linalg.norm(quat)
    for _ in range(round(2 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        assert data.qpos[2] > 0.05
    assert np.abs(data.qvel[:3]).max() < 0.05
    assert any(model.geom("trunk").id in contact.geom for contact in data.contact)
    assert data.qpos[2] < height + 0.005


def test_only_feet_and_trunk_of_the_quadruped_touch_the_floor():
    model = load("quadruped")
    names = {tuple(sorted(model.geom(g).name for g in (p.geom1, p.geom2))) for p in candidate_pairs(model)}
    assert names == {("floor", "trunk"), *(tuple(sorted(("floor", f"{leg}_foot"))) for leg in LEGS)}


# --- drive ------------------------------------------------------------------------------------------------------------

RADIUS, TRACK, FASTEST = 0.033, 0.16, 61 * 2 * np.pi / 60  # m, m, rad/s
# kg, and m over the floor, before the axle
BURGER = [(0.82573504, (-0.032, 0, 0.070)), (0.114, (-0.032, 0, 0.182)), (0.005, (-0.081, 0, 0.006))]
BURGER_INERTIA = (2.2124416e-03, 0, 0, 2.1193702e-03, 0, 2.0064271e-03)  # of the first part; the others are points


def drive(left, right, seconds=2.0):
    """C MuJoCo's data and heading [rad] after each step of so many seconds, half a second after the command."""
    model = load("drive")
    data = at_home(model)
    states, heading = [], 0.0
    data.ctrl[:] = left, right
    for number in range(round((0.5 + seconds) / model.opt.timestep)):
        mujoco.mj_step(model, data)
        if number >= round(0.5 / model.opt.timestep):
            heading += data.qvel[5] * model.opt.timestep
            states.append((*data.qpos[:2], heading))
    return data, np.array(states)


def test_masses_and_lengths_of_the_drive_are_the_makers():
    model = load("drive")
    wheel = 2.8498940e-02
    inertias = (BURGER_INERTIA, (0,) * 6, (0,) * 6)
    parts = [(m, np.array(c) - [0, 0, RADIUS], i) for (m, c), i in zip(BURGER, inertias, strict=True)]
    mass, centre, inertia = join(parts)
    np.testing.assert_allclose(model.body_mass[1:], [mass, wheel, wheel])
    np.testing.assert_allclose(model.body_mass.sum(), 1.0, atol=0.01)  # its weight in the list of specifications
    np.testing.assert_allclose(model.body("base").ipos, centre, atol=1e-6)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body("base").iquat)
    axes = rotation.reshape(3, 3)
    np.testing.assert_allclose(axes * model.body("base").inertia @ axes.T, inertia, atol=1e-8)
    np.testing.assert_allclose(model.body("left").pos - model.body("right").pos, [0, TRACK, 0])
    for side in ("left", "right"):
        assert model.geom(side).size[[0, 2]].tolist() == [RADIUS, RADIUS]
        np.testing.assert_allclose(model.body(side).inertia.max(), 2.0712558e-05, rtol=1e-6)


@pytest.mark.parametrize("speed", [0.5, 3.0, -3.0, FASTEST])
def test_equal_speeds_drive_straight_on(speed):
    """v = r w, to 0.5 %."""
    _, states = drive(speed, speed)
    way = states[-1, :2] - states[0, :2]
    np.testing.assert_allclose(way[0], RADIUS * speed * 1.995, rtol=0.005)
    np.testing.assert_allclose([way[1], states[-1, 2]], 0, atol=1e-4)


@pytest.mark.parametrize("speed", [0.5, 4.0, -4.0])
def test_opposite_speeds_turn_on_the_spot(speed):
    """2 r w / track, to 1 %; the middle of the axle stays within 5 mm."""
    _, states = drive(-speed, speed)
    np.testing.assert_allclose(states[-1, 2] - states[0, 2], 2 * RADIUS * speed / TRACK * 1.995, rtol=0.01)
    assert np.ptp(states[:, :2], axis=0).max() < 0.005


@pytest.mark.parametrize(("left", "right"), [(2, 4), (6, 3), (0, 4)])
def test_other_speeds_drive_a_circle(left, right):
    """Its radius is track / 2 (right + left) / (right - left), to 1 %."""
    _, states = drive(left, right, seconds=4.0)
    way = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1).sum()
    radius = way / (states[-1, 2] - states[0, 2])
    np.testing.assert_allclose(radius, TRACK / 2 * (right + left) / (right - left), rtol=0.01)


def test_servos_of_the_drive_follow_the_line_of_their_data_sheet():
    """1.5 N m at standstill, none at 61 rpm, and never more."""
    model = load("drive")
    data = at_home(model)
    for speed, command, torque in [(0, FASTEST, 1.5), (FASTEST, FASTEST, 0), (-FASTEST, FASTEST, 1.5), (3, 2, -0.2348)]:
        data.qvel[6:], data.ctrl[:] = speed, command
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.actuator_force, torque, atol=1e-3)


def test_full_reversals_tip_the_drive_but_do_not_turn_it_over():
    """It leaves its ball, by less than 0.15 rad, and comes back to it."""
    model = load("drive")
    data = at_home(model)
    tilts = []
    for command in (FASTEST, -FASTEST, FASTEST):
        data.ctrl[:] = command
        for _ in range(200):
            mujoco.mj_step(model, data)
            tilts.append(np.arccos(np.clip(data.body("base").xmat[8], -1, 1)))
        assert tilts[-1] < 1e-3
    assert 0.02 < max(tilts) < 0.15
