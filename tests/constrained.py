"""States of models with constraints: their accelerations by scalar equations in numpy, and by C MuJoCo's solver."""

import copy

import mujoco
import numpy as np
from dynamics import mjx

from envs.physics.dynamics import forward
from envs.physics.dynamics.constrained import make_solver
from envs.physics.interpreter import trace
from envs.physics.models import put_model
from envs.physics.numeric import evaluate
from envs.physics.pairs import colliding_pairs

FIELDS = ("qpos", "qvel", "ctrl", "act", "mocap_pos", "mocap_quat")


# --- ours -------------------------------------------------------------------------------------------------------------


def make_program(model, states, results, name="forward", pairs=None):
    """Our equations for `results`, as a function of C MuJoCo's data: those of `forward.forward` or `forward.step`."""
    mx = put_model(model)
    start = mjx.make_data(mx)
    solve = make_solver(colliding_pairs(model) if pairs is None else pairs)

    def function(*arrays):
        d = start.replace(**dict(zip(FIELDS, arrays, strict=True)))
        d = getattr(forward, name)(model, mx, d, solve)
        return [getattr(d, result) for result in results]

    def gather(states):
        return [np.stack([np.array(getattr(d, field)) for d in states]) for field in FIELDS]

    program = trace(function, *(x[0] for x in gather(states)))
    return lambda states: evaluate(program, gather(states))


def find_accelerations(model, states, results=("qacc",), pairs=None):
    """The results for a list of C MuJoCo's data."""
    return make_program(model, states, results, pairs=pairs)(states)


def make_stepper(model, states):
    """(qpos, qvel, act) after a step, as a function of such a list, without contacts."""
    return make_program(model, states, ("qpos", "qvel", "act"), "step", ())


# --- C MuJoCo's -------------------------------------------------------------------------------------------------------


def converge(model):
    """The model with the settings at which C MuJoCo's solver finds the minimum."""
    model = copy.copy(model)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.tolerance, model.opt.iterations = 0, 300
    model.opt.ls_tolerance, model.opt.ls_iterations = 1e-12, 100
    return model
