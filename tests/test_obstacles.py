"""What a model has no scalar equations for is named in the model's own words, at a glance."""

import logging
from itertools import combinations_with_replacement

import jax
import models
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.physics import MujocoModelError, UnsupportedPrimitiveError, compile_step, step
from envs.physics.interpreter import trace
from envs.physics.models import put_model
from envs.physics.obstacles import find_colliding_geoms, find_obstacles

SHAPES = {
    "plane": 'type="plane" size="1 1 0.1"',
    "hfield": 'type="hfield" hfield="hills"',
    "sphere": 'type="sphere" size="0.1"',
    "capsule": 'type="capsule" size="0.05 0.1"',
    "ellipsoid": 'type="ellipsoid" size="0.05 0.1 0.07"',
    "cylinder": 'type="cylinder" size="0.05 0.1"',
    "box": 'type="box" size="0.05 0.1 0.07"',
    "mesh": 'type="mesh" mesh="corner"',
}
ASSETS = """<asset><hfield name="hills" nrow="3" ncol="3" size="1 1 0.1 0.1"/>
<mesh name="corner" vertex="0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"/></asset>"""
PAIRS = [pair for pair in combinations_with_replacement(SHAPES, 2) if pair[1] not in ("plane", "hfield")]
QUICK = [("plane", "capsule"), ("plane", "box"), ("sphere", "cylinder"), ("capsule", "capsule")]


def touching(first, second, option=models.LOOP_FREE):
    """MJCF of a body that may touch another, or the ground."""
    ground = first in ("plane", "hfield")
    other = f'<geom name="one" {SHAPES[first]}/>'
    other = other if ground else f'<body pos="0 0 1"><freejoint/>{other}</body>'
    body = f'<body pos="0 0 0.5"><freejoint/><geom name="two" {SHAPES[second]}/></body>'
    return f'<mujoco model="pair">{option}{ASSETS}<worldbody>{other}{body}</worldbody></mujoco>'


@pytest.mark.parametrize(
    ("first", "second"),
    [pytest.param(*pair, marks=[] if pair in QUICK else pytest.mark.study, id="-".join(pair)) for pair in PAIRS],
)
def test_a_glance_tells_what_tracing_tells(first, second):
    """Of every two shapes of which MJX can find the contacts."""
    model = mujoco.MjModel.from_xml_string(touching(first, second))
    try:
        put_model(model)
    except MujocoModelError:
        return
    try:
        trace(*_traced(model))
    except UnsupportedPrimitiveError:
        assert find_obstacles(model)
    else:
        assert not find_obstacles(model)


def _traced(model):
    function, example = step.make_single_step(model, ("qpos", "qvel", "ctrl"), ("qpos", "qvel"))
    return function, *example


@pytest.mark.parametrize("name", [*models.SHIPPED, *models.MJCF, *models.CONSTRAINED, "panda", "panda with limits"])
def test_models_with_scalar_equations_have_no_obstacle(name):
    assert find_obstacles(models.make(name)) == []


@st.composite
def crowds(draw):
    """MJCF of a tree of bodies with spheres of random contype and conaffinity, some pairs excluded or listed."""
    masks = st.integers(0, 3)

    def geom(name):
        return f'<geom name="{name}" size="0.1" contype="{draw(masks)}" conaffinity="{draw(masks)}"/>'

    def body(i):
        joint = draw(st.sampled_from(["", '<joint axis="0 1 0"/>']))
        inside = "".join(body(j) for j in range(i + 1, count) if parents[j] == i)
        inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        return f'<body name="b{i}">{joint}{inertia}{geom(f"g{i}")}{inside}</body>'

    count = draw(st.integers(2, 5))
    parents = [-1] + [draw(st.integers(-1, i - 1)) for i in range(1, count)]
    bodies = "".join(body(i) for i in range(count) if parents[i] == -1)
    two = st.lists(st.integers(0, count - 1), min_size=2, max_size=2, unique=True)
    excluded, listed = draw(two), draw(two)
    contact = f'<exclude body1="b{excluded[0]}" body2="b{excluded[1]}"/>'
    if draw(st.booleans()):
        contact += f'<pair geom1="g{listed[0]}" geom2="g{listed[1]}"/>'
    flag = draw(st.sampled_from(["", '<option><flag filterparent="disable"/></option>']))
    return f"<mujoco>{flag}<worldbody>{geom('ground')}{bodies}</worldbody><contact>{contact}</contact></mujoco>"


@settings(deadline=None, max_examples=200)
@given(crowds())
def test_colliding_geoms_are_mujocos(xml):
    """All spheres lie in one place: what MuJoCo does not find in contact there it never will."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert {frozenset(pair) for pair in find_colliding_geoms(model)} == {
        frozenset(map(int, contact.geom)) for contact in data.contact
    }


LIMITS = models.chain(models.LIMITED, '<motor joint="slide"/>')
WRAPPED = models.chain(
    '<site name="wall" pos="0 0 1"/><geom name="post" type="cylinder" size="0.05 0.1"/>'
    + models.pole('<site name="tip" pos="0 0 0.6"/>'),
    '<motor tendon="rope"/>',
    more='<tendon><spatial name="rope"><site site="wall"/><geom geom="post"/><site site="tip"/></spatial></tendon>',
)


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        (touching("plane", "box"), ["geom 'one' (plane) and geom 'two' (box) can collide", "contype", "exclude"]),
        (touching("box", "mesh"), ["geom 'one' (box) and geom 'two' (mesh) can collide"]),
        (
            touching("plane", "sphere", ""),
            ["100 iterations", "contacts (of geom 'one' and geom 'two')", 'ls_iterations="4"'],
        ),
        (LIMITS, ["100 iterations of the solver", "the range of joint 'slide' and 1 more", '<option iterations="1"']),
        (WRAPPED, ["tendon 'rope' wraps around a geom"]),
        (models.chain(models.pole(joint='frictionloss="1"')), ["frictionloss", "iterations"]),
    ],
)
def test_the_feature_is_named_once(xml, words, caplog, monkeypatch):
    """With what it costs and where to read on, however many steps are made of the model."""
    model = mujoco.MjModel.from_xml_string(xml)
    monkeypatch.setattr(step, "_warned", set())
    with caplog.at_level(logging.WARNING):
        for num_substeps in (1, 2):
            compile_step(model, num_substeps)
    (record,) = caplog.records
    for text in (*words, "mjx.step", "slow", "docs/physics.md"):
        assert text in record.getMessage()


def test_a_glance_comes_before_tracing(monkeypatch):
    """Large models take minutes to trace."""
    monkeypatch.setattr(step, "trace", lambda *_: pytest.fail("traced"))
    compile_step(mujoco.MjModel.from_xml_string(LIMITS))


def test_disabled_constraints_are_no_obstacle():
    for flags in ("constraint", "limit"):
        option = f'<option><flag {flags}="disable"/></option>'
        assert find_obstacles(mujoco.MjModel.from_xml_string(models.chain(models.LIMITED, option=option))) == []
    box = touching("plane", "box", '<option><flag contact="disable"/></option>')
    assert find_obstacles(mujoco.MjModel.from_xml_string(box)) == []


def test_rangefinders_without_a_material_are_refused_in_one_line():
    ray = '<sensor><rangefinder site="eye"/></sensor>'
    model = mujoco.MjModel.from_xml_string(models.chain(models.pole('<site name="eye"/>'), more=ray))
    with pytest.raises(MujocoModelError, match=r'rangefinder.*<material name="any"/>'):
        compile_step(model)
    outputs = ("qpos", "qvel", "sensordata")
    state = np.zeros(model.nq), np.zeros(model.nv), np.zeros(0)
    assert jax.tree.map(np.shape, compile_step(model, outputs=outputs, physics="mujoco")(*state))[2] == (1,)
