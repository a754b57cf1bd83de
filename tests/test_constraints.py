"""Accelerations under constraints are those at which C MuJoCo's solver converges, to 1e-9 in float64."""

import copy

import jax
import mujoco
import numpy as np
import published
import pytest
from constrained import converge, find_accelerations, make_stepper
from dynamics import draw_state

from envs.physics import change_collision
from envs.physics.dynamics.choice import choose_pairs
from envs.physics.features import unsupported_features
from envs.physics.pairs import candidate_pairs, colliding_pairs

CONE = {"pyramidal": "CONTACT_PYRAMIDAL", "elliptic": "CONTACT_ELLIPTIC"}
BITS = mujoco.mjtConstraint


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


# --- models -----------------------------------------------------------------------------------------------------------


def write(bodies, more="", *, option="", flag="", default=""):
    return f"""<mujoco><compiler autolimits="true" angle="radian"/><default>{default}</default>
    <option timestep="0.005" {option}><flag {flag}/></option><worldbody>{bodies}</worldbody>{more}</mujoco>"""


def chain(hinge="", slide="", ball="", narrow=False):
    """A hinge, a slide and a ball, with ranges."""
    ranges = ("-.5 .7", "-.5 .8") if not narrow else ("-.2 .2", "-.1 .3")
    return f"""<body pos="0 0 1"><joint name="a" axis="0 1 .2" range="{ranges[0]}" {hinge}/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
      <body pos=".3 0 0"><joint name="b" type="slide" axis="1 .2 0" range="{ranges[1]}" {slide}/>
        <geom size=".05" pos=".1 0 0.1"/><site name="s1" pos=".1 .2 0" quat="1 .3 .2 0"/>
        <body pos=".3 0 0" name="e"><joint name="c" type="ball" range="0 1.2" {ball}/>
          <geom type="box" size=".05 .1 .07" pos=".1 .1 0"/><site name="s2" pos=".1 .2 0" quat="1 .3 .2 .5"/>
    </body></body></body><site name="w" pos="0 0 1.5"/>"""


FREE = """<body name="f" pos="1 0 1"><joint type="free" {0}/><geom type="box" size=".1 .2 .05" pos=".1 0 0"/>
  <site name="s4" pos=".1 .2 .3" quat="1 .2 .2 .2"/></body>"""
TENDONS = """<tendon>
  <fixed name="t1" range="-.1 .2" {0}><joint joint="a" coef=".7"/><joint joint="b" coef="-1"/></fixed>
  <spatial name="t2" range=".2 .6" {1}><site site="w"/><site site="s1"/><site site="s2"/></spatial>
  <spatial name="t3"><site site="w"/><site site="s2"/></spatial></tendon>"""
MOCAP = '<body name="m" mocap="true" pos="0 0 .5" quat="1 .3 .2 .1"/>'
ALONE = '<geom contype="0" conaffinity="0"/>'


def limit(*values, **options):
    """A chain without contacts, whose joints have these attributes."""
    return write(chain(*(values * 3)[:3], **options), default=ALONE)


def equate(*equalities, bodies="", more=""):
    """A chain and a free body with these equalities."""
    lines = "".join(f"<{equality}/>" for equality in equalities)
    return write(chain() + FREE.format("") + bodies, f"{more}<equality>{lines}</equality>", default=ALONE)


# Models, and the kinds of constraints that must have pushed or pulled in some of the states.
MODELS = {
    "limits": (limit(""), "LIMIT_JOINT"),
    "limits with a margin": (limit('margin=".2"'), "LIMIT_JOINT"),
    "limits with a negative margin": (limit('margin="-.1"'), "LIMIT_JOINT"),
    "both limits at once": (limit('margin=".5"', narrow=True), "LIMIT_JOINT"),
    "stiffness and damping": (limit('solreflimit="-300 -20"'), "LIMIT_JOINT"),
    "default for mixed signs": (limit('solreflimit=".1 -3"', 'solreflimit="-9 .3"'), "LIMIT_JOINT"),
    "a damper without a spring": (limit('solreflimit="0 -3"'), "LIMIT_JOINT"),
    "a short time constant": (limit('solreflimit=".001 1"'), "LIMIT_JOINT"),
    "any time constant": (write(chain('solreflimit=".001 1"'), default=ALONE, flag='refsafe="disable"'), "LIMIT_JOINT"),
    "impedance of power 1": (limit('solimplimit=".1 .8 .3 .5 1"'), "LIMIT_JOINT"),
    "impedance of power 3": (limit('solimplimit=".1 .95 .5 .3 3"'), "LIMIT_JOINT"),
    "impedance of power 2.5": (limit('solimplimit=".3 .95 .5 .7 2.5"'), "LIMIT_JOINT"),
    "impedance of power .5, taken as 1": (limit('solimplimit=".3 .9 .5 .4 .5"'), "LIMIT_JOINT"),
    "constant impedance": (limit('solimplimit=".6 .6 .5 .7 2"'), "LIMIT_JOINT"),
    "impedance without a width": (limit('solimplimit=".3 .9 0 .7 2"'), "LIMIT_JOINT"),
    "falling impedance": (limit('solimplimit=".9 .2 .4 .5 2"'), "LIMIT_JOINT"),
    "impedance out of bounds": (limit('solimplimit="-1 2 .5 1 3"', 'solimplimit=".3 .9 .5 0 3"'), "LIMIT_JOINT"),
    "friction loss": (
        write(
            chain('frictionloss="2" solreffriction=".1 1" solimpfriction=".5 .9 .1 .5 2"', 'frictionloss="30"')
            + FREE.format('frictionloss="3" solreffriction="-20 -3"'),
            default=ALONE,
        ),
        "LIMIT_JOINT FRICTION_DOF",
    ),
    "limits of tendons": (
        write(
            chain(),
            TENDONS.format('margin=".05" solreflimit="-100 -4"', 'solimplimit=".2 .8 .3 .4 3"'),
            default=ALONE,
        ),
        "LIMIT_TENDON",
    ),
    "both limits of a tendon": (write(chain(), TENDONS.format('margin=".3"', ""), default=ALONE), "LIMIT_TENDON"),
    "friction loss of tendons": (
        write(
            chain(),
            TENDONS.format('frictionloss="2" solreffriction=".1 2"', 'frictionloss="5" solimpfriction=".5 .9 .1 .5 2"'),
            default=ALONE,
        ),
        "FRICTION_TENDON",
    ),
    "points of bodies and sites": (
        equate(
            'connect body1="e" body2="f" anchor=".1 .2 0"',
            'connect body1="f" anchor="0 .1 .2" solref="-200 -10"',
            'connect site1="s2" site2="s4" solref=".05 .5" solimp=".5 .9 .5 .5 2"',
            'connect site1="w" site2="s1"',
        ),
        "EQUALITY",
    ),
    "frames of bodies and sites": (
        equate(
            'weld body1="e" body2="f" anchor=".3 .2 .1" torquescale="3" solimp=".2 .9 1 .5 2"',
            'weld body1="f" relpose="1 2 .3 1 .2 .3 .4" torquescale=".5"',
            'weld site1="s2" site2="s4" torquescale="2"',
            'weld site1="w" site2="s1"',
        ),
        "EQUALITY",
    ),
    "positions alone": (equate('weld body1="world" body2="f" anchor=".3 .2 .1" torquescale="0"'), "EQUALITY"),
    "mocap bodies": (
        equate('weld body1="m" body2="f"', 'connect body1="e" body2="m" anchor="0 0 0"', bodies=MOCAP),
        "EQUALITY",
    ),
    "polynomials of joints": (
        equate(
            'joint joint1="a" joint2="b" polycoef=".1 .5 -.3 .2 .1"',
            'joint joint1="b" polycoef=".2 3 0 0 0" solimp=".5 .9 .2 .5 2"',
            'joint joint1="b" joint2="a" active="false"',
        ).replace('name="a"', 'name="a" ref=".2"'),
        "EQUALITY",
    ),
    "polynomials of tendons": (
        equate(
            'tendon tendon1="t1" tendon2="t2" polycoef=".1 .5 -.3 .2 .1" solref=".1 .6"',
            'tendon tendon1="t3" polycoef=".2 3 0 0 0"',
            more=TENDONS.format("", ""),
        ),
        "EQUALITY LIMIT_TENDON",
    ),
}

# Bodies that touch each other and the ground, in trees of their own and in one, the ground being fixed or on a slide.
GROUND = '<geom name="ground" type="plane" size="3 3 1" {0}/>'
MOVING = """<body><joint type="slide" axis="0 .1 1" range="-.1 .1"/><joint axis="1 .3 .2"/>
  <geom name="ground" type="box" size="3 3 .1" pos="0 0 -.1" {0}/></body>"""
BOX = '<body name="box" pos="1 0 1"><freejoint/><geom name="box" type="box" size=".1 .05 .08" {0}/></body>'
BALL = '<body name="ball" pos="-1 0 1"><freejoint/><geom name="ball" size=".1" {1}/></body>'
ROUND = """<body pos="0 .3 .1"><joint axis="1 0 0"/><geom type="capsule" fromto="0 0 0 0 .3 0" size=".05" {2}/>
  <body pos="0 .3 0"><joint axis="1 .2 0" stiffness="1"/><geom type="capsule" fromto="0 0 0 0 .2 .05" size=".04" {3}/>
    <body pos="0 .2 .05"><joint axis="1 0 0"/><geom type="capsule" fromto="0 0 0 0 .2 .05" size=".04" {1}/>
</body></body></body>"""
ROUND += BALL  # so that bodies are not in the order of their depth
DIMENSIONS = ('condim="3"', 'condim="1"', 'condim="4" friction=".8 .2"', 'condim="6" friction="1 .2 .1"')
# Attributes of what moves and of the ground.
CONTACTS = {
    "parameters": (
        'condim="4" friction=".7 .02 .03" solref=".03 .8" solimp=".6 .9 .02 .4 3" margin=".02"',
        'friction=".3 .1 .01" solref="-500 -20" solmix="2"',
    ),
    "priority": (
        'condim="6" friction=".5 .02 .03" priority="1" solref=".05 .7"',
        'friction="2 .1 .01" solref=".02 1" solmix="2"',
    ),
    "no weights": ('solmix="0" solref=".04 1"', 'solmix="0" solref=".02 .5"'),
    "one weight": ('solmix="0" solref=".04 1"', 'solmix="3" solref=".02 .5"'),
    "no friction": ('friction="0 0 0"', 'friction="0 0 0"'),
    "gap": ('margin=".02" gap=".05"', 'margin=".01" gap=".02"'),
}


def touch(cone, own="", ground="", more="", impratio=1, place=GROUND, moving=ROUND, **options):
    own = own if isinstance(own, tuple) else (own,) * 4
    bodies = place.format(ground) + moving.format(*own)
    return write(bodies, more, option=f'cone="{cone}" impratio="{impratio}" {options.pop("option", "")}', **options)


def list_pairs(solreffriction):
    """The ball and the box touch the ground and each other by <pair>s."""
    numbers = 'friction=".7 .3 .02 .01 .03" solref=".03 1" margin=".03" solimp=".3 .9 .05 .5 2" gap=".1"'
    pairs = [f'<pair geom1="ground" geom2="{name}" condim="{condim}" solreffriction="{solref}" {numbers}/>'
             for name, condim, solref in zip(("ball", "box"), (6, 3), solreffriction, strict=True)]  # fmt: skip
    return f'<contact>{"".join(pairs)}<pair geom1="ball" geom2="box" condim="4" friction="1 .5 .2 .1 .05"/></contact>'


for cone, kind in CONE.items():
    for name, geoms in CONTACTS.items():
        MODELS[f"{cone} contacts, {name}"] = touch(cone, *geoms), kind
    of_all_dimensions = touch(cone, DIMENSIONS, 'condim="1"', impratio=3, moving=BOX + ROUND)
    MODELS[f"{cone} contacts of all dimensions"] = of_all_dimensions, f"{kind} CONTACT_FRICTIONLESS"
    MODELS[f"{cone} contacts, moving ground"] = touch(cone, place=MOVING), kind
    for name, damping in {"pairs": (".2 1", "0 -30"), "zero and mixed solreffriction": ("0 0", ".2 -1")}.items():
        pairs = touch(cone, more=list_pairs(damping), moving=BOX + BALL)
        MODELS[f"{cone} contacts, {name}"] = pairs, kind
    overridden = touch(
        cone, *CONTACTS["priority"], list_pairs(damping), moving=BOX + BALL, flag='override="enable"',
        option='o_margin=".01" o_solref=".03 .8" o_solimp=".6 .9 .02 .4 3" o_friction=".7 .3 .02 .01 .03"',
    )  # fmt: skip
    MODELS[f"{cone} contacts, overridden parameters"] = overridden, kind

# The fixed body has the higher number, and is first in one contact and second in the other.
LAST = '<body>{}<geom type="box" size=".1 .1 .1" pos=".1 0 0"/></body>'.format(GROUND.format(""))
MODELS["contacts with the last body"] = touch("pyramidal", place=BALL.format("", ""), moving=LAST), CONE["pyramidal"]

FLAGS = (
    "constraint",
    "equality",
    "frictionloss",
    "limit",
    "contact",
    "refsafe",
    "gravity",
    "warmstart",
    "filterparent",
)
ALL = write(
    chain('frictionloss="2" solreflimit=".001 1"') + FREE.format("") + GROUND.format('pos="0 0 .9"'),
    '<equality><connect body1="e" body2="f" anchor=".1 .2 0"/></equality>',
    flag='FLAG="disable"',
)


# --- states -----------------------------------------------------------------------------------------------------------


def gather(model, rng):
    """A state in which bodies that float are near each other and the ground."""
    d = draw_state(converge(model), rng)
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        begin = model.jnt_qposadr[joint]
        d.qpos[begin : begin + 3] = rng.uniform((-0.15, -0.15, -0.05), (0.15, 0.15, 0.25))
    return d


def scatter(model, rng):
    return draw_state(converge(model), rng)


def solve(model, draw=scatter, number=40):
    """(states, kinds): random states with C MuJoCo's solution, and the kinds of constraints that act in them."""
    rng, kinds = np.random.default_rng(0), set()
    states = [draw(model, rng) for _ in range(number)]
    for d in states:
        mujoco.mj_forward(converge(model), d)
        kinds |= {BITS(int(kind)).name.removeprefix("mjCNSTR_") for kind in d.efc_type[d.efc_force != 0]}
    return states, kinds


def agree(model, states, tolerance=1e-9, pairs=None):
    """Accelerations to 1e-9 of the largest one, and the constraints' forces to 1e-9 of the largest force."""
    for name, mine in zip(("qacc", "qfrc_constraint"), find_accelerations(model, states, FORCES, pairs), strict=True):
        true = np.stack([np.array(getattr(d, name)) for d in states])
        others = np.stack([np.array(d.qfrc_smooth) for d in states]) * (name != "qacc")
        size = np.maximum(np.abs(true).max(1), np.abs(others).max(1)).clip(1e-3)
        errors = np.abs(mine - true).max(1) / size
        assert errors.max() < tolerance, (name, errors.argmax(), errors.max())  # which is False for NaN


FORCES = ("qacc", "qfrc_constraint")


@pytest.mark.parametrize("name", MODELS)
def test_accelerations_are_mujocos(name):
    text, wanted = MODELS[name]
    model = mujoco.MjModel.from_xml_string(text)
    assert not unsupported_features(model)
    states, kinds = solve(model, gather if "contacts" in name else scatter)
    assert kinds >= set(wanted.split())
    agree(model, states)


@pytest.mark.parametrize("flag", FLAGS)
def test_flags(flag):
    """What each flag takes away."""
    model = mujoco.MjModel.from_xml_string(ALL.replace("FLAG", flag))
    states, kinds = solve(model, number=15)
    assert kinds or flag == "constraint"
    agree(model, states)


# --- published robots -------------------------------------------------------------------------------------------------

PUSHED = 0.3  # share of the range by which positions exceed it


def bend(model, rng):
    """A state with joints at and beyond their limits, and controls."""
    d = draw_state(converge(model), rng, speed=1.0)
    low, high = model.jnt_range.T
    for joint in np.flatnonzero((model.jnt_limited > 0) & (model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))):
        margin = PUSHED * (high[joint] - low[joint]) * (rng.random() < 0.5)
        d.qpos[model.jnt_qposadr[joint]] = rng.uniform(low[joint] - margin, high[joint] + margin)
    if model.njnt and model.jnt_type[0] == int(mujoco.mjtJoint.mjJNT_FREE):
        d.qpos[2] = rng.uniform(0.1, 0.5)
    return d


def load_colliding(name):
    """The robot without what it would do with its meshes, and the pairs of geoms whose contacts are equations."""
    model = change_collision(published.load(name), "primitives")
    features = unsupported_features(model)
    if features:
        pytest.skip(f"stepped by C MuJoCo: {features}")
    return model


@published.each_robot
def test_robots(name):
    """Their accelerations in states with limits active; contacts as far as they are equations, of the planes."""
    model = load_colliding(name)
    chosen, _ = choose_pairs(model, candidate_pairs(model))
    for geom in set(range(model.ngeom)) - {geom for pair in chosen for geom in (pair.geom1, pair.geom2)}:
        model.geom_contype[geom] = model.geom_conaffinity[geom] = 0
    exclude = {(pair.geom1, pair.geom2) for pair in colliding_pairs(model)} - {(p.geom1, p.geom2) for p in chosen}
    states, kinds = solve(model, bend, 30)
    states = [d for d in states if not exclude & {tuple(geoms) for geoms in d.contact.geom.tolist()}]
    assert len(states) > 10
    if model.jnt_limited.any():
        assert "LIMIT_JOINT" in kinds
    agree(model, states, pairs=chosen)


@pytest.mark.parametrize("name", ["franka_emika_panda/panda.xml", "robotiq_2f85/2f85.xml"])
def test_robots_move_as_by_mujoco(name):
    """Fifty steps, of which each starts from the end of ours: to 1e-9."""
    model = load_colliding(name)
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    states, _ = solve(model, bend, 5)
    step = make_stepper(model, states)
    others = [copy.copy(d) for d in states]
    for _ in range(50):
        qpos, qvel, act = step(states)
        for i, (d, other) in enumerate(zip(states, others, strict=True)):
            d.qpos[:], d.qvel[:], d.act[:] = qpos[i], qvel[i], act[i]
            mujoco.mj_step(converge(model), other)
    for d, other in zip(states, others, strict=True):
        np.testing.assert_allclose(d.qpos, other.qpos, atol=1e-7)
        np.testing.assert_allclose(d.qvel, other.qvel, atol=1e-5)
