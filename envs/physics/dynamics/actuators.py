"""Actuators: their dynamics, forces, limits, and the derivatives of the forces with respect to velocities."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import BIAS, DISABLED, DYNAMICS, GAIN, TRANSMISSION
from envs.physics.dynamics.forces import JOINT_TRANSMISSIONS, is_disabled
from envs.physics.dynamics.numbers import SMALL, at_least_small, get_number, is_zero, module_of
from envs.physics.dynamics.rotations import contract, length
from envs.physics.dynamics.smooth import Smooth
from envs.physics.dynamics.tree import BALL

if TYPE_CHECKING:
    from mujoco import mjx


def is_idle(model: mujoco.MjModel) -> bool:
    """Whether there are no actuators, or all are disabled by the flag."""
    return not model.nu or is_disabled(model, DISABLED.ACTUATION)


def find_enabled(model: mujoco.MjModel) -> np.ndarray:
    """Which actuators are in no disabled group [nu]; groups beyond 30 cannot be disabled."""
    group = model.actuator_group
    bits = model.opt.disableactuator >> np.clip(group, 0, 30) & 1
    return (group < 0) | (group > 30) | (bits == 0)


def add_actuator_forces(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth) -> mjx.Data:
    """The data with act_dot [na], actuator_force [nu] and qfrc_actuator [nv]."""
    if is_idle(model):
        return d.replace(
            act_dot=jnp.zeros(model.na), actuator_force=jnp.zeros(model.nu), qfrc_actuator=jnp.zeros(model.nv)
        )
    ctrl = _clamp(model, mx, d.ctrl, "ctrl", DISABLED.CLAMPCTRL)
    d = d.replace(act_dot=_find_activation_rates(model, mx, d, ctrl))
    gain, bias, _ = _find_gains(model, mx, d, smooth)
    force = gain * _find_inputs(model, mx, d, ctrl) + bias
    force = jnp.where(find_enabled(model), force, 0.0)
    force = _limit_tendons(model, mx, force)
    force = _clamp(model, mx, force, "force")
    total = contract(force, smooth.moment)
    by_actuators = model.jnt_actgravcomp[model.dof_jntid].astype(bool)
    if by_actuators.any():
        total = total + jnp.where(by_actuators, d.qfrc_gravcomp, 0.0)
    return d.replace(actuator_force=force, qfrc_actuator=_limit_joints(model, mx, total))


def _clamp(model, mx, x, name: str, flag: int | None = None):
    """The values within the actuators' ranges of this name, where these are limited."""
    limited = getattr(model, f"actuator_{name}limited").astype(bool)
    if not limited.any() or (flag is not None and is_disabled(model, flag)):
        return x
    low, high = get_number(model, mx, f"actuator_{name}range").T
    return jnp.where(limited, jnp.clip(x, low, high), x)


def _limit_tendons(model, mx, force):
    """Scales the forces of the actuators of a tendon where their sum is beyond the tendon's range."""
    at_tendon = model.actuator_trntype == TRANSMISSION.TENDON
    tendons = np.unique(model.actuator_trnid[at_tendon, 0])
    tendons = tendons[model.tendon_actfrclimited[tendons].astype(bool)] if tendons.size else tendons
    ranges = get_number(model, mx, "tendon_actfrcrange")
    for tendon in tendons:
        here = at_tendon & (model.actuator_trnid[:, 0] == tendon)
        total = contract(force, here.astype(float))
        limit = jnp.clip(total, ranges[tendon, 0], ranges[tendon, 1])
        scale = jnp.where(limit != total, limit / jnp.where(total == 0, 1.0, total), 1.0)
        force = jnp.where(here, force * jnp.where(total == 0, 1.0, scale), force)
    return force


def _limit_joints(model, mx, total):
    """The forces on the joints within the range of the joint's actuators, where that is limited."""
    limited = np.zeros(model.nv, bool)
    limited[model.jnt_dofadr] = model.jnt_actfrclimited
    if not limited.any():
        return total
    low, high = get_number(model, mx, "jnt_actfrcrange")[model.dof_jntid].T
    return jnp.where(limited, jnp.clip(total, low, high), total)


# --- inputs -----------------------------------------------------------------------------------------------------------


def _owners(model) -> np.ndarray:
    """The actuator of each activation [na]."""
    owners = np.zeros(model.na, int)
    for actuator, (begin, number) in enumerate(zip(model.actuator_actadr, model.actuator_actnum, strict=True)):
        if begin >= 0:
            owners[begin : begin + number] = actuator
    return owners


def _find_activation_rates(model, mx, d: mjx.Data, ctrl):
    """d act / dt [na]."""
    if not model.na:
        return jnp.zeros(0)
    owners = _owners(model)
    kind, u = model.actuator_dyntype[owners], ctrl[owners]
    prm = get_number(model, mx, "actuator_dynprm")[owners]
    filters = np.isin(kind, (DYNAMICS.FILTER, DYNAMICS.FILTEREXACT))
    time = module_of(prm).where(filters, module_of(prm).maximum(prm[:, 0], SMALL), 1.0)
    rate = jnp.where(filters, (u - d.act) / time, u)
    muscles = kind == DYNAMICS.MUSCLE
    return jnp.where(muscles, _find_muscle_rates(u, d.act, prm), rate) if muscles.any() else rate


def _find_muscle_rates(ctrl, act, prm):
    """(u - a) / tau, tau = tau_0 (0.5 + 1.5 a) for activation, tau_1 / (0.5 + 1.5 a) for deactivation, or in between.

    Args:
      ctrl, act: u and a [n]; within [0, 1] in the time constants.
      prm: tau_0, tau_1 and the width of u - a over which one goes smoothly into the other [n, >= 3].
    """
    excess = jnp.clip(ctrl, 0.0, 1.0) - act
    slower = 0.5 + 1.5 * jnp.clip(act, 0.0, 1.0)
    rising, falling, width = prm[:, 0] * slower, prm[:, 1] / slower, prm[:, 2]
    smooth = width >= SMALL
    x = jnp.clip(excess / module_of(width).where(smooth, width, 1.0) + 0.5, 0.0, 1.0)
    share = jnp.where(smooth, x**3 * (3.0 * x * (2.0 * x - 5.0) + 10.0), jnp.where(excess > 0, 1.0, 0.0))
    return excess / at_least_small(falling + (rising - falling) * share)


def find_next_activations(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, act_dot):
    """Activations after a step with these rates, within their ranges [na].

    An exact filter goes by act_dot tau (1 - exp(-h / tau)), everything else by act_dot h.
    """
    owners = _owners(model)
    step = get_number(model, mx, "opt.timestep")
    exact = model.actuator_dyntype[owners] == DYNAMICS.FILTEREXACT
    if exact.any():
        time = get_number(model, mx, "actuator_dynprm")[owners, 0]
        xp = module_of(time, step)
        time = xp.where(exact, xp.maximum(time, SMALL), 1.0)
        step = xp.where(exact, time * (1.0 - xp.exp(-step / time)), step)
    act = d.act + act_dot * step
    limited = model.actuator_actlimited[owners].astype(bool)
    if not limited.any():
        return act
    low, high = get_number(model, mx, "actuator_actrange")[owners].T
    return jnp.where(limited, jnp.clip(act, low, high), act)


def _find_inputs(model, mx, d: mjx.Data, ctrl):
    """What each gain multiplies: the control or the last activation, now or after the step [nu]."""
    inputs = ctrl
    if model.na:
        stateful = model.actuator_actnum > 0
        last = np.where(stateful, model.actuator_actadr + model.actuator_actnum - 1, 0)
        act = d.act[last]
        early = model.actuator_actearly.astype(bool)
        if (early & stateful).any():
            act = jnp.where(early, find_next_activations(model, mx, d, d.act_dot)[last], act)
        inputs = jnp.where(stateful, act, ctrl)
    return _wrap(inputs, d.actuator_length, find_periods(model, mx))


def find_periods(model: mujoco.MjModel, mx: mjx.Model) -> Any:
    """Period of the set-points of position servos on rotations, 2 pi |gear|, and 0 for other actuators [nu]."""
    gear, target = get_number(model, mx, "actuator_gear"), model.actuator_trnid
    at_joint = np.isin(model.actuator_trntype, JOINT_TRANSMISSIONS)
    if model.njnt:
        at_joint &= model.jnt_type[np.where(at_joint, target[:, 0], 0)] == BALL
    at_site = (model.actuator_trntype == TRANSMISSION.SITE) & (target[:, 1] >= 0)
    turns = (at_joint | (at_site & ~model.actuator_gear[:, :3].any(-1))) & (
        (model.actuator_gaintype == GAIN.FIXED)
        & (model.actuator_biastype == BIAS.AFFINE)
        & np.isin(model.actuator_dyntype, (DYNAMICS.NONE, DYNAMICS.INTEGRATOR))
    )
    if not turns.any():
        return np.zeros(model.nu)
    is_servo = get_number(model, mx, "actuator_gainprm")[:, 0] == -get_number(model, mx, "actuator_biasprm")[:, 1]
    turning = jnp.where(at_site[:, None], gear[:, 3:], gear[:, :3])
    return 2.0 * np.pi * length(turning) * (turns & is_servo)


def _wrap(setpoint, length, period):
    """The set-points nearest to the lengths of those that differ by whole periods."""
    if is_zero(period):
        return setpoint
    safe = jnp.where(period > 0, period, 1.0)
    turns = jnp.floor((setpoint - length) / safe + 0.5)
    return jnp.where(period > 0, setpoint - period * turns, setpoint)


def wrap_activations(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, act):
    """Set-points stored in activations, as the ones nearest to the lengths [na]."""
    owners = _owners(model)
    period = find_periods(model, mx)[owners] * (model.actuator_dyntype[owners] == DYNAMICS.INTEGRATOR)
    return _wrap(act, d.actuator_length[owners], period)


# --- gains ------------------------------------------------------------------------------------------------------------


def _find_gains(model, mx, d: mjx.Data, smooth: Smooth):
    """Gain, bias and the derivatives of both with respect to the velocity, (gain, bias, (gain', bias')), [nu] each."""
    gains, biases = (get_number(model, mx, f"actuator_{name}prm") for name in ("gain", "bias"))
    length, v = d.actuator_length, smooth.actuator_velocity
    affine = model.actuator_gaintype == GAIN.AFFINE
    gain = gains[:, 0] + affine * gains[:, 1] * length + affine * gains[:, 2] * v
    affine_bias = model.actuator_biastype == BIAS.AFFINE
    bias = affine_bias * biases[:, 0] + affine_bias * biases[:, 1] * length + affine_bias * biases[:, 2] * v
    slopes = affine * gains[:, 2], affine_bias * biases[:, 2]
    muscles = model.actuator_gaintype == GAIN.MUSCLE
    muscle_biases = model.actuator_biastype == BIAS.MUSCLE
    if muscles.any() or muscle_biases.any():
        active, slope, passive = _find_muscle_forces(model, mx, length, v, gains, biases)
        gain, slopes = jnp.where(muscles, active, gain), (jnp.where(muscles, slope, slopes[0]), slopes[1])
        bias = jnp.where(muscle_biases, passive, bias)
    return gain, bias, slopes


def _find_muscle_forces(model, mx, length, velocity, gains, biases):
    """Active force per activation, its derivative with respect to velocity, and passive force, of muscles [nu]."""
    ranges, acc0 = get_number(model, mx, "actuator_lengthrange"), get_number(model, mx, "actuator_acc0")
    size, L = _normalize_length(length, ranges, gains)
    speed = at_least_small(size * gains[:, 6])
    curve, slope = _evaluate_velocity_curve(velocity / speed, gains[:, 8])
    active = -_peak_force(gains, acc0) * _evaluate_length_curve(L, gains[:, 4], gains[:, 5])
    _, L = _normalize_length(length, ranges, biases)
    end = 0.5 * (1.0 + biases[:, 5])
    x = (L - 1.0) / at_least_small(end - 1.0)
    beyond = (L - end) / at_least_small(end - 1.0)
    stretch = jnp.where(L <= 1, 0.0, jnp.where(end >= L, 0.5 * x * x, 0.5 + beyond))
    return active * curve, active * slope / speed, -_peak_force(biases, acc0) * biases[:, 7] * stretch


def _normalize_length(length, ranges, prm):
    """The optimal length, and the length in units of it."""
    size = (ranges[:, 1] - ranges[:, 0]) / at_least_small(prm[:, 1] - prm[:, 0])
    return size, prm[:, 0] + (length - ranges[:, 0]) / at_least_small(size)


def _peak_force(prm, acc0):
    """The given peak force, or if that is negative the scale over the acceleration of unit force."""
    return module_of(prm, acc0).where(prm[:, 2] < 0, prm[:, 3] / at_least_small(acc0), prm[:, 2])


def _evaluate_length_curve(L, low, high):
    """A bump made of four parabolas, 1 at L = 1 and 0 from `low` down and from `high` up."""
    rise, fall = 0.5 * (low + 1.0), 0.5 * (1.0 + high)
    ends = (L - low) / at_least_small(rise - low), (high - L) / at_least_small(high - fall)
    middles = (1.0 - L) / at_least_small(1.0 - rise), (L - 1.0) / at_least_small(fall - 1.0)
    left = jnp.where(rise >= L, 0.5 * ends[0] ** 2, 1.0 - 0.5 * middles[0] ** 2)
    right = jnp.where(fall >= L, 1.0 - 0.5 * middles[1] ** 2, 0.5 * ends[1] ** 2)
    return jnp.where((low > L) | (high < L), 0.0, jnp.where(L <= 1, left, right))


def _evaluate_velocity_curve(V, top):
    """Force over that at rest, and its derivative: 0 up to V = -1, (V + 1)^2 up to 0, and on to `top` by a parabola."""
    y = top - 1.0
    safe = at_least_small(y)
    value = jnp.where(V <= 0, (V + 1.0) ** 2, jnp.where(y >= V, top - (y - V) ** 2 / safe, top))
    slope = jnp.where(V <= 0, 2.0 * V + 2.0, jnp.where(y >= V, 2.0 * (y - V) / safe, 0.0))
    return jnp.where(V <= -1, 0.0, value), jnp.where(V <= -1, 0.0, slope)


# --- derivatives ------------------------------------------------------------------------------------------------------


def find_actuator_derivative(model: mujoco.MjModel, mx: mjx.Model, d: mjx.Data, smooth: Smooth):
    """Derivative of qfrc_actuator with respect to qvel, as C MuJoCo has it [nv, nv], symmetric.

    Without actuators at their own force limit; the limits of tendons and joints do not matter to it.
    """
    result = np.zeros((model.nv, model.nv))
    if is_idle(model):
        return result
    _, _, (gain, bias) = _find_gains(model, mx, d, smooth)
    if is_zero(gain) and is_zero(bias):
        return result
    slope = bias
    if not is_zero(gain):
        ctrl = _clamp(model, mx, d.ctrl, "ctrl", DISABLED.CLAMPCTRL)
        slope = slope + gain * _find_inputs(model, mx, d, ctrl)
    counted = find_enabled(model)
    limited = model.actuator_forcelimited.astype(bool)
    if limited.any():
        low, high = get_number(model, mx, "actuator_forcerange").T
        inside = (d.actuator_force > low) & (d.actuator_force < high)
        counted = counted & (inside | ~limited)
    slope = jnp.where(counted, slope, 0.0)
    return contract(smooth.moment.T * slope, smooth.moment)
