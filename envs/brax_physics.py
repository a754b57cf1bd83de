"""brax's environments with another MuJoCo step than MJX's.

Like brax's own physics "mjx", an action is the control of all physics steps, and poses and velocities of the links are
those before the last of them. The state has only what environments read of it: brax carries all of `mjx.Data`.
"""

from __future__ import annotations

import copy
from typing import Any

import jax
import jax.numpy as jnp
from brax import base
from flax import struct

from envs.physics import compile_forward, compile_step
from envs.physics.forward import normalize_quaternions

FIELDS = ("xpos", "xquat", "cvel", "subtree_com")  # of which brax makes poses and velocities of links


@struct.dataclass
class PipelineState(base.State):
    """brax's state: q, qd, x, xd, and no contacts.

    Attributes:
      qacc_warmstart: the acceleration from which the next step's solver starts, `[nv]`.
    """

    qacc_warmstart: jax.Array = struct.field(default_factory=lambda: jnp.zeros(0))


def replace_physics(env: Any, physics: str) -> Any:
    """The same environment, whose physics is `compile_step` with `physics`.

    Args:
      env: brax's, with the physics "mjx".
      physics: "scalar" or "mujoco".
    """
    model = copy_model(env.sys)
    state = ("qpos", "qvel", "qacc_warmstart")
    place = compile_forward(model, inputs=("qpos", "qvel"), outputs=FIELDS, physics=physics)
    advance = compile_step(model, env._n_frames, inputs=(*state, "ctrl"), outputs=(*state, *FIELDS), physics=physics)

    def init(q, qd, act=None, ctrl=None):
        q = normalize_quaternions(model, q)
        x, xd = find_motion(model, *place(q, qd))
        return PipelineState(q=q, qd=qd, x=x, xd=xd, contact=None, qacc_warmstart=jnp.zeros_like(qd))

    def step(state, action):
        qpos, qvel, qacc, *fields = advance(state.q, state.qd, state.qacc_warmstart, action)
        x, xd = find_motion(model, *fields)
        return PipelineState(q=qpos, qd=qvel, x=x, xd=xd, contact=None, qacc_warmstart=qacc)

    env.pipeline_init, env.pipeline_step = init, step
    return env


def copy_model(sys: base.System) -> Any:
    """The system's MuJoCo model with the time step and the flags that an environment has changed.

    What it changes of the solver is of no influence on the solution.
    """
    model = copy.copy(sys.mj_model)
    model.opt.timestep, model.opt.disableflags = float(sys.opt.timestep), int(sys.opt.disableflags)
    return model


def find_motion(model: Any, xpos, xquat, cvel, subtree_com) -> tuple[base.Transform, base.Motion]:
    """Poses and velocities of the links in the world, from fields of MuJoCo's bodies.

    MuJoCo's `cvel` is the velocity of the point of a body that is at the centre of mass of its whole tree.
    """
    spin, arm = cvel[1:, :3], xpos[1:] - subtree_com[model.body_rootid[1:]]
    velocity = cvel[1:, 3:] + jnp.cross(spin, arm)
    return base.Transform(pos=xpos[1:], rot=xquat[1:]), base.Motion(ang=spin, vel=velocity)
