"""MuJoCo models that the physics is tested on: what people build arms, carts and bodies of."""

import mujoco
import numpy as np

import envs
from envs.base import ASSETS
from envs.physics import load_spec

# One iteration of the solver with few steps of its line search: without a loop whose length depends on the data.
LOOP_FREE = '<option iterations="1" ls_iterations="4"/>'


def chain(body, actuators="", option="", more=""):
    return f"""<mujoco><compiler autolimits="true"/><option timestep="0.005"/>{option}
    <default><geom contype="0" conaffinity="0"/></default>
    <worldbody>{body}</worldbody>{more}<actuator>{actuators}</actuator></mujoco>"""


def pole(child="", name="pole", joint=""):
    return f"""<body pos="0 0 0.1"><joint name="{name}" axis="0 1 0" {joint}/>
    <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.04"/>{child}</body>"""


def cart(child="", name="slide", axis="1 0 0", joint=""):
    return f"""<body><joint name="{name}" type="slide" axis="{axis}" {joint}/>
    <geom type="box" size="0.2 0.1 0.05" mass="2"/>{child}</body>"""


def with_pole(joint, shape):
    return f"<body>{joint}{shape}{pole()}</body>"


MJCF = {
    "cart-pole": chain(cart(pole()), '<motor joint="slide" gear="10"/>'),
    "double pendulum": chain(pole(pole(name="second")), '<motor joint="pole"/>'),
    "double pendulum, no motor": chain(pole(pole(name="second"))),
    "slide joints": chain(cart(cart(name="second", axis="0.6 0.8 0")), '<motor joint="slide"/><motor joint="second"/>'),
    "ball joint": chain(
        with_pole('<joint type="ball" damping="0.3"/>', '<geom type="capsule" fromto="0 0 0 0.3 0 0.2" size="0.05"/>'),
        '<motor joint="pole"/>',
    ),
    "free body": chain(
        with_pole("<freejoint/>", '<geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0"/>'), '<motor joint="pole"/>'
    ),
    "damping, stiffness, armature": chain(
        pole(joint='damping="0.4" stiffness="3" springref="0.5" armature="0.2"'), '<motor joint="pole"/>'
    ),
    "position and velocity servos": chain(
        cart(pole(), joint='damping="1"'),
        '<position joint="slide" kp="30" kv="4"/><velocity joint="pole" kv="2" forcerange="-1 1" ctrlrange="-2 2"/>',
    ),
    "fixed tendon": chain(
        cart(pole()),
        '<motor tendon="t" gear="2"/>',
        more="""<tendon><fixed name="t" stiffness="2" damping="0.5"><joint joint="slide" coef="1"/>
        <joint joint="pole" coef="-0.5"/></fixed></tendon>""",
    ),
    "implicitfast": chain(
        cart(pole(joint='damping="0.5"'), joint='damping="1"'),
        '<velocity joint="pole" kv="2"/>',
        '<option integrator="implicitfast"/>',
    ),
    "Runge-Kutta": chain(cart(pole()), '<motor joint="slide"/>', '<option integrator="RK4"/>'),
}
LIMITED = cart(pole(joint='range="-0.5 0.5"'), joint='range="-0.5 0.5"')
CONSTRAINED = {
    "joint limits": chain(LIMITED, '<motor joint="slide"/>', LOOP_FREE),
    "joint limits, Newton": chain(
        LIMITED, '<motor joint="slide"/>', LOOP_FREE.replace("/>", ' solver="Newton" jacobian="dense"/>')
    ),
    "joint limits, CG": chain(
        LIMITED, '<motor joint="slide"/>', LOOP_FREE.replace("/>", ' solver="CG" jacobian="sparse"/>')
    ),
    "friction loss": chain(cart(pole(), joint='frictionloss="2"'), '<motor joint="slide"/>', LOOP_FREE),
    "equality": chain(
        cart(pole()),
        '<motor joint="slide"/>',
        LOOP_FREE,
        '<equality><joint joint1="slide" joint2="pole" polycoef="0.1 0.5 0 0 0"/></equality>',
    ),
    "all constraints": chain(
        LIMITED.replace("/>", ' frictionloss="1"/>', 1) + pole(name="other"),
        '<motor joint="slide"/>',
        LOOP_FREE.replace("/>", ' solver="Newton"/>'),
        '<equality><joint joint1="slide" joint2="other" polycoef="0.1 0.5 0 0 0"/></equality>',
    ),
}
SHIPPED = {
    "pendulum": ("pendulum", {}),
    "arm, torque": ("arm", {}),
    "arm, velocity": ("arm", {"control": "velocity"}),
    "arm, upright": ("arm", {"gravity": True}),
    "arm, upright, velocity": ("arm", {"gravity": True, "control": "velocity"}),
}


def panda(limits):
    spec = load_spec(ASSETS / "panda.xml")
    if not limits:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return spec.compile()


def make(name):
    if name in SHIPPED:
        environment, options = SHIPPED[name]
        return envs.make(environment, **options).model
    if name.startswith("panda"):
        return panda(limits="limits" in name)
    return mujoco.MjModel.from_xml_string((MJCF | CONSTRAINED)[name])


def random_states(model, n, seed=0):
    """qpos with unit quaternions, qvel and ctrl, the last beyond its range too; float64."""
    random = np.random.default_rng(seed)
    qpos = random.uniform(-2, 2, (n, model.nq))
    for kind, address in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            begin = address + (3 if kind == mujoco.mjtJoint.mjJNT_FREE else 0)
            qpos[:, begin : begin + 4] /= np.linalg.norm(qpos[:, begin : begin + 4], axis=1, keepdims=True)
    limit = np.where(model.actuator_ctrllimited, model.actuator_ctrlrange[:, 1], 2.0)
    return qpos, random.normal(size=(n, model.nv)), limit * random.uniform(-1.2, 1.2, (n, model.nu))


def by_mujoco(model, states):
    """qpos and qvel after `mj_step` from each of the states, in float64."""
    data = mujoco.MjData(model)
    results = []
    for qpos, qvel, ctrl in zip(*states, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_step(model, data)
        results.append((data.qpos.copy(), data.qvel.copy()))
    return [np.stack(x) for x in zip(*results, strict=True)]
