"""Contacts between pairs of shapes are those of C MuJoCo, and what geometry says they are."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from envs.physics.dynamics.shapes import NUM_CONTACTS, PAIRS, Shape
from envs.physics.interpreter import trace
from envs.physics.numeric import evaluate

SIZES = {
    "plane": (1.0, 1.0, 0.1),
    "sphere": (0.1, 0.0, 0.0),
    "capsule": (0.05, 0.1, 0.0),
    "ellipsoid": (0.05, 0.1, 0.07),
    "cylinder": (0.05, 0.1, 0.0),
    "box": (0.05, 0.1, 0.07),
}
MARGIN = 0.02
NUMBER = 400  # pairs in a test
# MuJoCo's errors of distance, position and normal [m, m, 1] for pairs of which it approaches the deepest contact.
APPROACHED = {
    ("sphere", "ellipsoid"): (1e-7, 1e-5, 1e-3),
    ("capsule", "ellipsoid"): (1e-7, 1e-5, 1e-3),
    ("ellipsoid", "ellipsoid"): (1e-4, 1e-3, 0.1),
    ("capsule", "cylinder"): (1e-3, 1e-2, 1e-3),
}
pairs = pytest.mark.parametrize("pair", PAIRS, ids="-".join)
exact_pairs = pytest.mark.parametrize("pair", [pair for pair in PAIRS if pair not in APPROACHED], ids="-".join)
approached_pairs = pytest.mark.parametrize("pair", APPROACHED, ids="-".join)


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def rotate(rng, angle=np.pi):
    """A rotation by at most this angle."""
    axis, matrix, quaternion = rng.normal(size=3), np.zeros(9), np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, axis / np.linalg.norm(axis), rng.uniform(0, angle))
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def align(rng):
    """One of the 24 rotations of a cube."""
    matrix = np.eye(3)[rng.permutation(3)] * rng.choice([-1, 1], 3)
    return matrix * np.linalg.det(matrix)


# How the second shape is turned against the first: at random, or aligned with it but for an angle, or exactly.
TURNS = {
    "any": rotate,
    "nearly aligned": lambda rng: rotate(rng, 10 ** rng.uniform(-5, -0.5)) @ align(rng),
    "aligned": align,
}


def draw(pair, number=NUMBER, turn="any", seed=0, spread=0.1):
    """Random pairs of shapes, most of which touch."""
    rng = np.random.default_rng(seed)
    sizes = [SIZES[name] * rng.uniform(0.5, 1.5, (number, 3)) for name in pair]
    positions = rng.uniform(-spread, spread, (2, number, 3))
    first = np.stack([np.eye(3) if turn == "aligned" else rotate(rng) for _ in range(number)])
    second = np.stack([TURNS[turn](rng) for _ in range(number)])
    return Shape(positions[0], first, sizes[0]), Shape(positions[1], first @ second, sizes[1])


@functools.cache
def make_model(pair):
    geoms = [f'<geom name="{i}" type="{pair[i]}" size="{" ".join(map(str, SIZES[pair[i]]))}"/>' for i in range(2)]
    bodies = [geom if 'type="plane"' in geom else f"<body><freejoint/>{geom}</body>" for geom in geoms]
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>{"".join(bodies)}</worldbody>
    <contact><pair geom1="0" geom2="1" margin="{MARGIN}"/></contact>
    <option><flag multiccd="{"disable" if pair in APPROACHED else "enable"}"/></option></mujoco>""")
    model.geom_rbound[model.geom_rbound > 0] = 10
    return model


def find_by_mujoco(pair, first, second):
    """Lists of (distance, position, frame)."""
    model = make_model(pair)
    data, results = mujoco.MjData(model), []
    mujoco.mj_forward(model, data)
    for shapes in zip(zip(*first, strict=True), zip(*second, strict=True), strict=True):
        for geom, (position, rotation, size) in enumerate(shapes):
            data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom] = position, rotation.ravel(), size
        mujoco.mj_collision(model, data)
        contact = data.contact
        results.append((contact.dist.copy(), contact.pos.copy(), contact.frame.reshape(-1, 3, 3).copy()))
    return results


@functools.cache
def compile_pair(pair):
    return jax.jit(jax.vmap(lambda a, b: PAIRS[pair](a, b, MARGIN)))


def find(pair, first, second):
    """A list of (distance, position, frame) of all possible contacts, by one program for any number of pairs."""
    number = len(first.position)
    full = [Shape(*(np.resize(part, (NUMBER, *part.shape[1:])) for part in shape)) for shape in (first, second)]
    contacts = compile_pair(pair)(*full)
    for part in contacts:
        assert np.isfinite(part).all()
    assert contacts.distance.shape[1] == NUM_CONTACTS[pair]
    return list(zip(*(np.asarray(part)[:number] for part in contacts), strict=True))


def compare(mine, true):
    """The largest errors of distance, position and frame of the contacts within the margin, in any order."""
    touching = mine[0] <= MARGIN
    mine = [part[touching] for part in mine]
    if len(mine[0]) != len(true[0]):
        return [np.inf] * 3
    gaps = np.linalg.norm(mine[1][:, None] - true[1], axis=2) + abs(mine[0][:, None] - true[0])
    order = linear_sum_assignment(gaps.T)[1]
    return [abs(ours[order] - theirs).max(initial=0) for ours, theirs in zip(mine, true, strict=True)]


def agree(pair, first, second, tolerance=(1e-10, 1e-10, 1e-8)):
    """That the contacts are C MuJoCo's; returns how many pairs touch."""
    true = find_by_mujoco(pair, first, second)
    errors = [compare(*both) for both in zip(find(pair, first, second), true, strict=True)]
    np.testing.assert_array_less(errors, np.broadcast_to(tolerance, (len(errors), 3)))
    return sum(len(contacts[0]) > 0 for contacts in true)


def stack(*shapes):
    return Shape(*(np.stack(parts) for parts in zip(*shapes, strict=True)))


@pytest.mark.parametrize("turn", TURNS)
@exact_pairs
def test_contacts_are_mujocos(pair, turn):
    """Distances and positions to 1e-10 m, frames to 1e-8, which two nearly parallel axes lose by cancellation."""
    assert agree(pair, *draw(pair, turn=turn)) > 200


@approached_pairs
def test_contacts_are_near_mujocos(pair):
    """Where the sphere's centre, or the capsule's axis, is outside, and ellipsoids overlap by less than 2 cm.

    MuJoCo may add contacts beside the deepest one of a capsule and a cylinder, which its flag multiccd prevents.
    """
    shapes = draw(pair)
    touching = 0
    for mine, true, depth in zip(
        find(pair, *shapes), find_by_mujoco(pair, *shapes), limit_depth(pair, shapes), strict=True
    ):
        if mine[0] > -depth:
            mine, true = ([*contacts[:2], contacts[2][:, :1]] for contacts in (mine, true))
            np.testing.assert_array_less(compare(mine, true), APPROACHED[pair])
            touching += mine[0][0] <= MARGIN
    assert touching > 100


def limit_depth(pair, shapes):
    if pair[0] == "ellipsoid":
        return np.full(NUMBER, 0.02)
    return shapes[0].size[:, 0] * (0.5 if pair[1] == "cylinder" else 1)


@approached_pairs
def test_distance_is_proved_by_the_points_and_the_normal(pair):
    """The points half the distance away are in the shapes, so these are not further apart, and the shapes reach no
    further along the normal than these points, so they are not nearer.
    """
    shapes = draw(pair, spread=0.2, seed=3)
    checked = 0
    for contact, depth, *numbers in zip(
        find(pair, *shapes), limit_depth(pair, shapes), *shapes[0], *shapes[1], strict=True
    ):
        distance, position, normal = contact[0][0], contact[1][0], contact[2][0, 0]
        if distance > -depth:
            for name, shape, side in zip(pair, (Shape(*numbers[:3]), Shape(*numbers[3:])), (1, -1), strict=True):
                point = (position - side * 0.5 * distance * normal - shape.position) @ shape.rotation
                assert measure_excess(name, shape.size, point) < 1e-8
                direction = side * normal @ shape.rotation
                np.testing.assert_allclose(direction @ point, reach(name, shape.size, direction), rtol=0, atol=1e-8)
            checked += 1
    assert checked > 200


def measure_excess(name, size, point):
    """How far a point is outside of a shape at the origin, roughly for an ellipsoid."""
    if name == "ellipsoid":
        return np.linalg.norm(point / size) - 1
    if name == "cylinder":
        return max(np.linalg.norm(point[:2]) - size[0], abs(point[2]) - size[1])
    length = size[1] if name == "capsule" else 0
    return np.linalg.norm(point - [0, 0, np.clip(point[2], -length, length)]) - size[0]


def reach(name, size, direction):
    """The support function: how far a shape at the origin reaches along a unit vector."""
    if name == "ellipsoid":
        return np.linalg.norm(size * direction)
    length = size[1] * abs(direction[2]) if name in ("capsule", "cylinder") else 0
    return length + size[0] * (np.linalg.norm(direction[:2]) if name == "cylinder" else 1)


@pairs
def test_distant_shapes_do_not_touch(pair):
    """Of shapes a metre apart no contact is within the margin; a plane is put below the other shape."""
    first, second = draw(pair, spread=0.3)
    apart = first.rotation[:, :, 2] if pair[0] == "plane" else np.array([1.0, 0, 0])
    second = second._replace(position=first.position + apart)
    for distance, *_ in find(pair, first, second):
        assert (distance > MARGIN).all()


def place(size, position=(0.0, 0, 0), angle=0.0, axis=(0.0, 0, 1)):
    rotation, quaternion = np.zeros(9), np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, np.array(axis), angle)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return Shape(np.array(position), rotation.reshape(3, 3), np.array(size))


BOX, ROD, DISC = (0.25, 0.5, 0.125), (0.125, 0.5, 0.0), (0.25, 0.125, 0.0)
LYING = {"angle": np.pi / 2, "axis": (1.0, 0, 0)}
AT_REST = {  # exactly: in binary numbers
    "box on a plane": ("plane", "box", place((1, 1, 1)), place(BOX, (0, 0, 0.125))),
    "cylinder on a plane": ("plane", "cylinder", place((1, 1, 1)), place(DISC, (0, 0, 0.125))),
    "upright capsule on a plane": ("plane", "capsule", place((1, 1, 1)), place(ROD, (0, 0, 0.625))),
    "box on an equal box": ("box", "box", place(BOX), place(BOX, (0, 0, 0.25))),
    "box beside a box": ("box", "box", place(BOX), place(BOX, (0.125, 0.5, 0.25))),
    "box on a smaller box": ("box", "box", place((0.125, 0.25, 0.5)), place(BOX, (0, 0, 0.625))),
    "square across a square": (
        "box",
        "box",
        place((0.5, 0.5, 0.5)),
        place((0.5, 0.5, 0.5), (0, 0, 0.96875), np.pi / 4),
    ),
    "boxes in one place": ("box", "box", place(BOX), place(BOX)),
    "sphere in a box's centre": ("sphere", "box", place((0.5, 0, 0)), place((0.25, 0.25, 0.25))),
    "sphere in a cylinder's centre": ("sphere", "cylinder", place((0.5, 0, 0)), place((0.125, 0.25, 0))),
    "sphere on a capsule's axis": ("sphere", "capsule", place((0.5, 0, 0)), place(ROD, (0, 0, 0.25))),
    "spheres in one place": ("sphere", "sphere", place((0.5, 0, 0)), place((0.25, 0, 0))),
    "parallel capsules": ("capsule", "capsule", place(ROD), place(ROD, (0.25, 0, 0.25))),
    "capsules in a row": ("capsule", "capsule", place(ROD), place(ROD, (0, 0, 1.25))),
    "capsules in one place": ("capsule", "capsule", place(ROD), place(ROD)),
    "crossed capsules": ("capsule", "capsule", place(ROD), place(ROD, angle=0.7, axis=(1.0, 0, 0))),
    "capsule upright on a box": ("capsule", "box", place(ROD, (0, 0.25, 0.75)), place(BOX)),
}


@pytest.mark.parametrize("name", AT_REST)
def test_contacts_at_rest_are_mujocos(name):
    """Where several answers are as good, as for axes that are parallel or centres that coincide."""
    *pair, first, second = AT_REST[name]
    assert agree(tuple(pair), stack(first), stack(second)) == 1


@pairs
def test_moving_both_shapes_moves_their_contacts(pair):
    first, second = draw(pair, spread=0.2)
    turn, shift = rotate(np.random.default_rng(1)), np.array([3.0, -2.0, 1.0])
    moved = [Shape(s.position @ turn.T + shift, turn @ s.rotation, s.size) for s in (first, second)]
    for before, after in zip(find(pair, first, second), find(pair, *moved), strict=True):
        expected = before[0], before[1] @ turn.T + shift, before[2][:, :1] @ turn.T
        assert max(compare((after[0], after[1], after[2][:, :1]), [x[before[0] <= MARGIN] for x in expected])) < 1e-8


@pytest.mark.parametrize("name", [name for name, other in PAIRS if name == other])
def test_contacts_are_those_of_the_swapped_shapes(name):
    first, second = draw((name, name), seed=2, spread=0.2)
    for one, other in zip(find((name, name), first, second), find((name, name), second, first), strict=True):
        expected = [one[0], one[1], -one[2][:, :1]]
        assert max(compare((other[0], other[1], other[2][:, :1]), [x[one[0] <= MARGIN] for x in expected])) < 1e-8


@pairs
def test_gradients_are_finite(pair):
    """Also where axes are parallel, faces flush or centres coincide."""
    offsets = [(0, 0, 0), (0, 0, 0.1), (0.1, 0, 0), (0.05, 0.1, 0), (0.05, 0.1, 0.07), (0.1, 0.2, 0.14), (1, 0, 0)]
    turns = [np.eye(3), *(place((), angle=np.pi / 2, axis=axis).rotation for axis in np.eye(3))]
    ones = [place(SIZES[pair[0]]) for _ in offsets for _ in turns]
    others = [Shape(np.array(offset, float), turn, np.array(SIZES[pair[1]])) for offset in offsets for turn in turns]

    def weigh(a, b):
        return sum(jnp.sum(jnp.cos(jnp.arange(x.size).reshape(x.shape)) * x) for x in PAIRS[pair](a, b, MARGIN))

    program = trace(jax.grad(weigh, argnums=(0, 1)), ones[0], others[0])
    for part in evaluate(program, jax.tree.leaves((stack(*ones), stack(*others)))):
        assert np.isfinite(part).all()


@pairs
def test_scalar_equations_are_the_same(pair):
    shapes = draw(pair)
    example = [Shape(*(jnp.zeros(x.shape[1:]) for x in shape)) for shape in shapes]
    program = trace(lambda a, b: PAIRS[pair](a, b, MARGIN), *example)
    for mine, true in zip(evaluate(program, jax.tree.leaves(shapes)), compile_pair(pair)(*shapes), strict=True):
        np.testing.assert_allclose(mine, true, rtol=1e-9, atol=1e-9)
