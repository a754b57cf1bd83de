"""States of small models stepped by `envs.physics.dynamics` and by C MuJoCo."""

import mujoco
import numpy as np

from envs.physics.dynamics import forward
from envs.physics.interpreter import trace
from envs.physics.models import import_mjx, put_model
from envs.physics.numeric import evaluate

mjx = import_mjx()
FLAG = mujoco.mjtDisableBit
STATE = ("qpos", "qvel", "act")

# All kinds of joints, in two trees, with branches, several joints on a body, a welded body, a camera, and sites.
BODIES = """
<body name="a" pos="0 0 1">
  <joint name="j1" axis=".3 1 .2" damping=".3" stiffness="2" springref="20"/>
  <geom type="capsule" size=".03" fromto="0 0 0 .3 0 .1"/>
  <site name="s1" pos=".1 .05 .02" quat="1 .3 .2 .1"/>
  <body name="b" pos=".3 0 .1">
    <joint name="j2" type="slide" axis="1 0 .3" pos=".1 0 .2" damping=".2"/><joint name="j3" axis="0 0 1" pos=".1 0 0"/>
    <geom type="box" size=".1 .05 .08" pos=".1 0 0"/>
    <body name="welded" pos=".1 0 0" quat="1 .2 0 0"><geom size=".05" pos=".1 .1 0"/><site name="s6"/></body>
    <site name="s2" pos=".2 .05 .02" quat="1 0 .2 .4"/>
    <body name="c" pos=".25 0 0" quat="1 0 .3 0">
      <joint name="j4" type="ball" pos=".05 .02 0" stiffness=".4" damping=".1"/>
      <geom name="g" type="box" size=".05 .1 .03" pos="0 .1 0" quat="1 .2 .1 0"/>
      <camera name="cam" pos=".1 0 .2" quat="1 .2 0 .3"/>
      <site name="s3" pos=".05 .1 .06" quat="1 .3 .2 .4"/>
    </body>
  </body>
  <body name="e" pos="0 .2 .1">
    <joint name="j5" axis="1 0 0" damping=".1" armature=".02"/>
    <geom type="box" size=".05 .1 .03" pos="0 .1 0"/><site name="s5" pos="0 .2 0"/>
  </body>
</body>
<body name="f" pos="1 0 1" quat="1 1 0 0">
  <freejoint name="fj"/><geom type="box" size=".1 .2 .05" pos=".1 0 0"/>
  <site name="s4" pos=".1 .2 .3" quat="1 .2 .2 .2"/>
</body>
<site name="w" pos=".5 .5 1" quat="1 .3 0 0"/>"""
TENDONS = """<tendon>
<fixed name="t1" stiffness="3" damping=".5" springlength=".1 .2" armature=".05">
  <joint joint="j1" coef=".7"/><joint joint="j5" coef="-1.2"/></fixed>
<spatial name="t2" stiffness="20" damping="1.5" armature=".2" springlength=".3">
  <site site="w"/><site site="s1"/><site site="s3"/><pulley divisor="2"/>
  <site site="s3"/><site site="s5"/><site site="s4"/></spatial></tendon>"""


def write_mjcf(bodies=BODIES, extra="", integrator="Euler", options="", flag=""):
    """An MJCF with these bodies and options."""
    flag = f"<flag {flag}/>" if flag else ""
    return f"""<mujoco><compiler autolimits="true"/>
      <option timestep="0.01" integrator="{integrator}" {options}>{flag}</option>
      <worldbody>{bodies}</worldbody>{extra}</mujoco>"""


def compile_unconstrained(text):
    """The model in an MJCF, without constraints and contacts."""
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= FLAG.mjDSBL_CONSTRAINT | FLAG.mjDSBL_CONTACT
    return model


def make_function(model, results, name="step"):
    """(qpos, qvel, act, ctrl, **others) -> results, by `forward.step` or `forward.forward`."""
    mx = put_model(model)
    start = mjx.make_data(mx)

    def function(qpos, qvel, act, ctrl, **others):
        d = start.replace(qpos=qpos, qvel=qvel, act=act, ctrl=ctrl, **others)
        d = getattr(forward, name)(model, mx, d, forward.unconstrained, also=results)
        return {result: getattr(d, result) for result in results}

    return function


def draw_state(model, rng, speed=3.0):
    """C MuJoCo's data with random positions, velocities, activations and controls, some of them beyond limits."""
    d = mujoco.MjData(model)
    mujoco.mj_integratePos(model, d.qpos, rng.normal(size=model.nv), 1.0)
    d.qvel[:] = speed * rng.normal(size=model.nv)
    d.act[:] = rng.uniform(-0.2, 1.2, model.na)
    limited = model.actuator_ctrllimited.astype(bool)[:, None]
    low, high = np.where(limited, model.actuator_ctrlrange, [[-2.0, 2.0]]).T
    d.ctrl[:] = 0.5 * (low + high) + 0.6 * (high - low) * rng.uniform(-1, 1, model.nu)
    return d


def compute(function, *arguments):
    """The results of a function by its scalar equations, as a list of arrays: faster than to compile it."""
    arguments = [np.asarray(x, float) for x in arguments]
    return [x[0] for x in evaluate(trace(function, *arguments), [x[None] for x in arguments])]


def find_errors(model, results, steps=1, states=30, name="step", speed=3.0, others=(), change=None):
    """The largest error of each result after some steps, relative to its own size or to 1 if that is larger.

    Args:
      model: without constraints.
      results: fields of the data.
      steps: number of steps.
      states: number of random states, with controls that are kept.
      name: "step" or "forward".
      speed: size of the random velocities.
      others: fields of the data that are arguments too.
      change: (data of C MuJoCo, generator) sets these.
    """
    inputs = (*STATE, "ctrl", *others)
    wanted = (*STATE, *(result for result in results if result not in STATE))
    function = make_function(model, wanted, name)
    rng = np.random.default_rng(0)
    batch = [draw_state(model, rng, speed) for _ in range(states)]
    for d in batch:
        if change:
            change(d, rng)

    def read(field):
        return np.stack([np.array(getattr(d, field)) for d in batch])

    arguments = [read(field) for field in inputs]
    ours = {}
    program = trace(
        lambda *args: tuple(function(**dict(zip(inputs, args, strict=True))).values()), *(x[0] for x in arguments)
    )
    for _ in range(steps):
        ours = dict(zip(wanted, evaluate(program, arguments), strict=True))
        arguments = [*(ours[part] for part in STATE), *arguments[len(STATE) :]]
        for d in batch:
            getattr(mujoco, f"mj_{name}")(model, d)
    errors = {}
    for result in results:
        true = read(result)
        mine = ours[result].reshape(true.shape)
        size = np.maximum(1.0, np.abs(true).reshape(states, -1).max(1, initial=0.0))
        errors[result] = float((np.abs(mine - true).reshape(states, -1).max(1, initial=0.0) / size).max())
    return errors
