"""Pairs of geoms are MuJoCo's; those left out never meet, in any position that the joints can take."""

import itertools

import mujoco
import numpy as np
import published
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from envs.physics import reach
from envs.physics.pairs import candidate_pairs, colliding_pairs, find_margin
from envs.physics.reach import Reach

SHAPES = ('size="0.1"', 'type="capsule" size="0.1 0.1"', 'type="box" size="0.1 0.1 0.1"')
PLANE = 'type="plane" size="1 1 1"'


@st.composite
def crowds(draw):
    """MJCF of a tree of bodies in one place, of random contype and conaffinity, some pairs excluded or listed."""
    masks = st.integers(0, 3)

    def geom(name, shapes=SHAPES):
        dims = f'condim="{draw(st.sampled_from([1, 3, 4, 6]))}" priority="{draw(st.integers(0, 1))}"'
        shape, margin = draw(st.sampled_from(shapes)), draw(st.sampled_from([0, 0.01]))
        kinds = f'contype="{draw(masks)}" conaffinity="{draw(masks)}"'
        return f'<geom name="{name}" {shape} {dims} margin="{margin}" {kinds}/>'

    def body(i):
        joint = draw(st.sampled_from(["", '<joint axis="0 1 0"/>']))
        attribute = 'mocap="true"' if parents[i] == -1 and not joint and draw(st.booleans()) else ""
        inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        inside = "".join(body(j) for j in range(i + 1, count) if parents[j] == i)
        return f'<body name="b{i}" {attribute}>{joint}{inertia}{geom(f"g{i}")}{inside}</body>'

    count = draw(st.integers(2, 5))
    parents = [-1] + [draw(st.integers(-1, i - 1)) for i in range(1, count)]
    bodies = "".join(body(i) for i in range(count) if parents[i] == -1)
    two = st.lists(st.integers(0, count - 1), min_size=2, max_size=2, unique=True)
    excluded, listed = draw(two), draw(two)
    contact = f'<exclude body1="b{excluded[0]}" body2="b{excluded[1]}"/>'
    if draw(st.booleans()):
        contact += f'<pair geom1="g{listed[0]}" geom2="g{listed[1]}" condim="4"/>'
    flag = draw(st.sampled_from(["", '<option><flag filterparent="disable"/></option>']))
    bodies = geom("ground", (*SHAPES, PLANE)) + bodies
    return f"<mujoco>{flag}<worldbody>{bodies}</worldbody><contact>{contact}</contact></mujoco>"


@settings(deadline=None, max_examples=300)
@given(crowds())
def test_candidate_pairs_are_mujocos(xml):
    """All geoms lie in one place: what MuJoCo does not find in contact there it never will."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    true = {(*map(int, contact.geom), contact.dim, contact.includemargin) for contact in data.contact}
    pairs = candidate_pairs(model)
    assert {(pair.geom1, pair.geom2, pair.condim, find_margin(model, pair)) for pair in pairs} == true
    for pair in pairs:
        named = [(model.pair_geom1[i], model.pair_geom2[i]) for i in range(model.npair)]
        assert (pair.index >= 0) == bool({(pair.geom1, pair.geom2), (pair.geom2, pair.geom1)} & set(named))


@pytest.mark.parametrize("flag", ["contact", "constraint"])
def test_there_is_no_pair_where_contacts_are_disabled(flag):
    body = '<body><freejoint/><geom size="0.1"/></body>'
    xml = f'<mujoco><option>{{}}</option><worldbody><geom size="0.1"/>{body}</worldbody></mujoco>'
    assert len(candidate_pairs(mujoco.MjModel.from_xml_string(xml.format("")))) == 1
    model = mujoco.MjModel.from_xml_string(xml.format(f'<flag {flag}="disable"/>'))
    assert candidate_pairs(model) == []


def test_planes_do_not_touch_each_other():
    """Not even where the model lists the pair."""
    planes = '<geom name="a" type="plane" size="1 1 1"/><geom name="b" type="plane" size="1 1 1" pos="0 0 -1"/>'
    ball = '<body><freejoint/><geom name="c" size="0.1"/></body>'
    pair = '<contact><pair geom1="a" geom2="b"/></contact>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{planes}{ball}</worldbody>{pair}</mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.contact.geom.tolist() == [[0, 2]]
    assert [(pair.geom1, pair.geom2) for pair in candidate_pairs(model)] == [(0, 2), (1, 2)]


# --- pairs that never meet --------------------------------------------------------------------------------------------


def folding(low, high, tip='pos="1 0 0" size="0.05"', more=""):
    """Two links of 1 m, one after the other, each bending by `low` to `high` degrees, with a ball at each end."""
    elbow = f'<body pos="1 0 0"><joint name="elbow" axis="0 1 0" range="{low} {high}"/>'
    return f"""<mujoco><compiler autolimits="true"/><default><geom mass="1"/></default><worldbody>{more}
    <body><joint axis="0 1 0" name="shoulder"/><geom name="root" size="0.05"/><body pos="1e-9 0 0">
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint axis="0 0 1" range="-1 1"/>{elbow}
    <geom name="tip" {tip}/></body></body></body></worldbody></mujoco>"""


def are_near(xml, **changes):
    model = mujoco.MjModel.from_xml_string(xml)
    return [(model.geom(x.geom1).name, model.geom(x.geom2).name) for x in candidate_pairs(model, **changes)] != []


def test_a_pair_goes_where_the_elbow_cannot_close_and_stays_where_it_can():
    """The distance of root and tip is `2 cos(angle / 2)`: they touch, 0.1 m apart, from 174.3 degrees on."""
    allowance = np.degrees(reach.ALLOWANCE["hinge"])
    assert not are_near(folding(-10, 174.2 - allowance))
    assert are_near(folding(-10, 174.4 - allowance))
    assert are_near(folding(-10, 10), varying=("body_mass", "geom_size"))
    assert not are_near(folding(-10, 10), varying=("body_mass",))


@pytest.mark.parametrize(
    "xml",
    [
        folding(-10, 10).replace('range="-10 10"', ""),
        folding(-10, 10).replace('range="-10 10"', 'range="-10 10" limited="false"'),
        folding(-10, 10).replace("<worldbody>", '<option><flag limit="disable"/></option><worldbody>'),
        folding(-10, 10, tip='pos="1 0 0" size="0.05" margin="2"'),
        folding(-10, 10).replace('axis="0 1 0" range="-10 10"', 'type="ball"'),
        folding(-10, 10).replace("</mujoco>", '<keyframe><key qpos="0 0 3.1"/></keyframe></mujoco>'),
        folding(-10, 10, tip='type="capsule" fromto="-1 0 0 1 0 0" size="0.05"'),
        folding(-10, 10, tip='type="box" pos="1 0 0" size="1.96 0.01 0.01"'),
        folding(-10, 10, tip='type="ellipsoid" pos="1 0 0" euler="0 90 0" size="0.01 0.01 1.96"'),
    ],
)
def test_a_pair_stays_where_it_may_meet(xml):
    """Without limits, with a margin, about a ball joint, from a keyframe, and for long shapes."""
    assert are_near(xml)


def test_bodies_that_are_moved_from_outside_may_be_anywhere():
    mocap = '<body mocap="true" pos="9 9 9"><geom name="hand" size="0.05"/></body>'
    model = mujoco.MjModel.from_xml_string(folding(-10, 10, more=mocap))
    assert len(candidate_pairs(model)) == len(colliding_pairs(model)) - 1
    static = mocap.replace('mocap="true"', "")
    assert candidate_pairs(mujoco.MjModel.from_xml_string(folding(-10, 10, more=static))) == []


def test_planes_are_half_spaces():
    """A tip that cannot turn below the floor is free of it, whichever way the floor looks."""
    floor = '<geom name="floor" type="plane" size="1 1 1" pos="0 0 {}" euler="{} 0 0"/>'
    fixed = folding(-10, 10).replace('axis="0 1 0" name="shoulder"', 'axis="0 1 0" range="-60 60"')
    for height, angle, meets in ((-1.99, 0, True), (-2.06, 0, False), (-2.06, 180, True), (2.06, 180, False)):
        xml = fixed.replace("<worldbody>", "<worldbody>" + floor.format(height, angle))
        assert are_near(xml) == meets, (height, angle)


def random_positions(model, number):
    """Positions within the widened ranges, a part of them at their ends; free joints stay where they are."""
    random, known = np.random.default_rng(3), Reach(model)
    bounded = np.flatnonzero(np.isfinite(known._low))
    low, high = known._low[bounded], known._high[bounded]
    for _ in range(number):
        values = random.uniform(low, high)
        at_end = random.uniform(size=len(low)) < random.choice([0, 0.5])
        values = np.where(at_end, np.where(random.uniform(size=len(low)) < 0.5, low, high), values)
        qpos = model.qpos0.copy()
        qpos[model.jnt_qposadr[bounded]] = values
        yield qpos


@published.each_robot
def test_no_contact_of_a_published_robot_is_missed(name):
    """In positions within the widened ranges, by MuJoCo's own collision detection."""
    model = published.load(name)
    data = mujoco.MjData(model)
    kept = {frozenset((pair.geom1, pair.geom2)) for pair in candidate_pairs(model)}
    for qpos in random_positions(model, 20_000):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        assert {frozenset(geoms) for geoms in data.contact.geom.tolist()} <= kept


@pytest.mark.parametrize("name", ["unitree_go1/scene.xml", "aloha/aloha.xml", "universal_robots_ur5e/ur5e.xml"])
def test_pairs_of_published_robots_get_fewer(name):
    model = published.load(name)
    before, after = colliding_pairs(model), candidate_pairs(model)
    assert set(after) < set(before)
    assert len(after) < 0.85 * len(before)


# --- the bound --------------------------------------------------------------------------------------------------------


def chain(random, number):
    """MJCF of a chain of random links with a geom at each end, and hinges and slides of random axes between."""

    def numbers(size=3):
        return " ".join(f"{x:.4f}" for x in random.uniform(-1, 1, size))

    inner = f'<geom pos="{numbers()}" type="capsule" size="0.05 0.3" euler="{numbers()}"/>'
    for _ in range(number):
        kind = random.choice(["hinge", "slide"])
        joint = f'<joint type="{kind}" pos="{numbers()}" axis="{numbers()}" range="-0.5 0.7"/>'
        inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        inner = f'<body pos="{numbers()}" euler="{numbers()}">{joint}{inertia}{inner}</body>'
    geom = f'<geom pos="{numbers()}" type="box" size="0.1 0.2 0.3" euler="{numbers()}"/>'
    return f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{geom}{inner}</worldbody></mujoco>'


def test_the_bound_holds_in_boxes_of_every_size():
    """The distance anywhere in a box is at least the one at its centre less what the joints may change."""
    random = np.random.default_rng(0)
    tightest = np.inf
    for number in range(150):
        model = mujoco.MjModel.from_xml_string(chain(random, random.integers(1, 5)))
        known, pairs = Reach(model), [(0, 1, 0.0)]
        joints = known._find_chain(0, model.nbody - 1)
        search = reach._Search(known, joints, pairs, np.array([0, 1]), np.array([0]), np.array([1]))
        low, high = np.sort(random.uniform(known._low, known._high, (2, model.nq)), 0)
        high = low + (high - low) * 4.0 ** (1 - number % 4)
        centre, half = (low + high) / 2, (high - low) / 2
        distance, moves = search.bound(centre[None], half[None])
        inside = random.uniform(low, high, (300, model.nq))
        inside[:100] = np.where(random.uniform(size=(100, model.nq)) < 0.5, low, high)
        others, _ = search.bound(inside, np.zeros_like(inside))
        slack = others.min() - (distance[0, 0] - moves[0, 0].sum())
        assert slack >= -1e-9
        tightest = min(tightest, slack / moves[0, 0].sum())
    assert tightest < 0.2  # the bound is not an empty one


def test_an_arm_that_slides_out_turns_further():
    """Out by `a = 4 m`, it comes nearer to what is behind it by `a (1 - cos h)` if it turns by `h`."""
    joints = '<joint axis="0 1 0" range="-90 90"/><joint type="slide" axis="1 0 0" range="0 4"/>'
    arm = f'<body>{joints}<geom mass="1" pos="0.1 0 0" size="0.1"/></body>'
    xml = f'<mujoco><compiler autolimits="true"/><worldbody><geom pos="-10 0 0" size="0.1"/>{arm}</worldbody></mujoco>'
    known = Reach(mujoco.MjModel.from_xml_string(xml))
    search = reach._Search(known, [0, 1], [(0, 1, 0.0)], np.array([0, 1]), np.array([0]), np.array([1]))
    distance, moves = search.bound(np.array([[0.0, 3.9]]), np.array([[0.5, 0.0]]))
    np.testing.assert_allclose(distance, 13.8)
    assert 4 * (1 - np.cos(0.5)) < moves.sum() < 0.6


def test_crossing_capsules_have_the_distance_of_inner_points():
    """Two long ones, one above the other at a right angle: their axes are 0.5 m apart, their ends much further."""
    one = '<geom type="capsule" fromto="-1 0.2 0 1 0.2 0" size="0.1"/>'
    other = '<geom type="capsule" fromto="0.3 -1 0.5 0.3 1 0.5" size="0.15"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{one}{other}</worldbody></mujoco>")
    search = reach._Search(Reach(model), [], [(0, 1, 0.0)], np.array([0, 1]), np.array([0]), np.array([1]))
    (ours,), _ = search.bound(np.zeros((1, 0)), np.zeros((1, 0)))
    np.testing.assert_allclose(ours[0], 0.25)


def test_the_gap_of_segments_is_the_least():
    """As of bounded least squares: skew, parallel and nearly parallel, crossing segments, and points."""
    random = np.random.default_rng(0)
    offset, u, v = random.normal(size=(3, 100, 3))
    v[::4] = u[::4] * random.uniform(-2, 2, (25, 1))
    v[1::4] = u[1::4] + 1e-7 * random.normal(size=(25, 3))
    offset[::3] *= 0.05
    u[::10], v[::15] = 0, 0
    lengths = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
    ours = np.linalg.norm(reach.find_gap(offset, u, v, *lengths, reach.PARALLEL), axis=1)
    columns = np.stack([u, -v], 2)
    least = [lsq_linear(a, -b, (-1, 1), tol=1e-15) for a, b in zip(columns, offset, strict=True)]
    np.testing.assert_allclose(ours, [np.sqrt(2 * each.cost) for each in least], rtol=1e-7, atol=1e-7)


def test_capsules_enclose_the_geoms():
    """Distances between capsules are at most MuJoCo's between the geoms, and equal for spheres and capsules."""
    random = np.random.default_rng(1)
    sizes = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
    for one, other in itertools.combinations_with_replacement(sizes, 2):
        shapes = [
            f'<geom type="{shape}" size="{" ".join(map(str, random.uniform(0.05, 0.4, sizes[shape])))}" '
            f'pos="{i * 3} 0 0" euler="{" ".join(map(str, random.uniform(0, 90, 3)))}"/>'
            for i, shape in enumerate((one, other))
        ]
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(shapes)}</worldbody></mujoco>")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        true = mujoco.mj_geomDistance(model, data, 0, 1, 10, None)
        search = reach._Search(Reach(model), [], [(0, 1, 0.0)], np.array([0, 1]), np.array([0]), np.array([1]))
        (ours,), _ = search.bound(np.zeros((1, 0)), np.zeros((1, 0)))
        assert ours[0] <= true + 1e-6
        if {one, other} <= {"sphere", "capsule"}:
            np.testing.assert_allclose(ours[0], true, atol=1e-6)
