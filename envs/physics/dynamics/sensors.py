"""The values of sensors."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.dynamics.codes import DATA, DISABLED, OBJECT, SENSOR, TRANSMISSION
from envs.physics.dynamics.contact_sensors import read_contact, read_touch
from envs.physics.dynamics.forces import find_armature, find_tendon_forces, is_disabled
from envs.physics.dynamics.kinematics import find_accelerations, find_body_velocities, find_carried, find_carriers
from envs.physics.dynamics.numbers import SMALL, get_number, is_zero
from envs.physics.dynamics.rays import MISS, find_distance, is_inside
from envs.physics.dynamics.reactions import Reactions
from envs.physics.dynamics.rotations import (
    IDENTITY,
    conjugate,
    contract,
    cross_each,
    multiply,
    normalize,
    rotate_back,
    rotate_each,
    subtract,
)
from envs.physics.dynamics.smooth import Smooth
from envs.physics.dynamics.transmissions import find_tendon_pulls, find_tendon_rates
from envs.physics.dynamics.tree import BALL, FREE
from envs.physics.models import import_mjx
from envs.physics.pairs import SHAPES

if TYPE_CHECKING:
    from mujoco import mjx
# Sensors that depend on the constraints.
OF_CONSTRAINTS = frozenset(
    getattr(SENSOR, name)
    for name in (
        "TOUCH", "CONTACT", "JOINTLIMITPOS", "JOINTLIMITVEL", "JOINTLIMITFRC", "TENDONLIMITPOS", "TENDONLIMITVEL",
        "TENDONLIMITFRC", "ACCELEROMETER", "FORCE", "TORQUE", "FRAMELINACC", "FRAMEANGACC",
    )
)  # fmt: skip
JOINT_LIMITS = [SENSOR.JOINTLIMITPOS, SENSOR.JOINTLIMITVEL, SENSOR.JOINTLIMITFRC]
TENDON_LIMITS = [SENSOR.TENDONLIMITPOS, SENSOR.TENDONLIMITVEL, SENSOR.TENDONLIMITFRC]


def add_readings(model: mujoco.MjModel, mx: mjx.Model, d: Any, smooth: Smooth, names=(), sensors: bool = True) -> Any:
    """The data with sensordata, and with those of the fields energy and cfrc_ext that are named.

    Args:
      model: the model.
      mx: its numbers.
      d: with everything else.
      smooth: what the forces are made from; without its `constraints`, sensors that read them are 0.
      names: fields to compute.
      sensors: whether to read the sensors, of which kinds that are not supported stay 0.
    """
    reader = _Reader(model, mx, d, smooth)
    if sensors and model.nsensor and not is_disabled(model, DISABLED.SENSOR):
        d = d.replace(sensordata=jnp.concatenate([_read(reader, sensor) for sensor in range(model.nsensor)]))
    if "energy" in names:
        d = d.replace(energy=jnp.stack([_read_potential_energy(reader, -1), _read_kinetic_energy(reader, -1)]))
    if "cfrc_ext" in names:
        d = d.replace(cfrc_ext=_read_outer_forces(reader))
    return d


def _read(reader: _Reader, sensor: int):
    """The values of a sensor."""
    model = reader.model
    dim, read = int(model.sensor_dim[sensor]), READERS.get(int(model.sensor_type[sensor]))
    value = jnp.zeros(dim) if read is None else jnp.reshape(jnp.asarray(read(reader, sensor)), dim)
    return _cut_off(model, sensor, value)


def _cut_off(model, sensor: int, value):
    """The value within the sensor's cutoff, if it has one."""
    cutoff, kind = float(model.sensor_cutoff[sensor]), model.sensor_datatype[sensor]
    if cutoff <= 0 or model.sensor_type[sensor] in (SENSOR.CONTACT, SENSOR.GEOMFROMTO):
        return value
    if kind == DATA.REAL:
        return jnp.clip(value, -cutoff, cutoff)
    return jnp.minimum(value, cutoff) if kind == DATA.POSITIVE else value


class _Reader:
    """What the sensors of one evaluation share, computed when the first sensor needs it."""

    def __init__(self, model, mx, d, smooth: Smooth):
        self.model, self.mx, self.d, self.smooth = model, mx, d, smooth

    def number(self, name: str):
        return get_number(self.model, self.mx, name)

    @functools.cached_property
    def reactions(self) -> Reactions | None:
        """The forces of the constraints, if a solver has found any."""
        constraints = self.smooth.constraints
        if constraints is None or not (constraints.sections or constraints.contacts):
            return None
        return Reactions(self.model, self.mx, self.d, self.smooth, constraints)

    @functools.cached_property
    def gravity(self):
        return np.zeros(3) if is_disabled(self.model, DISABLED.GRAVITY) else self.number("opt.gravity")

    @functools.cached_property
    def velocities(self):
        return find_body_velocities(self.smooth.tree, self.smooth.poses, self.d)

    @functools.cached_property
    def accelerations(self):
        return find_accelerations(self.smooth.tree, self.smooth.poses, self.d, self.gravity, self.d.qacc)

    @functools.cached_property
    def cameras(self):
        return import_mjx().camlight(self.mx, self.d)

    def frame(self, kind: int, number: int):
        """Body, position, axes and orientation of an object; the world if the number is -1."""
        model, d = self.model, self.d
        if number < 0:
            return 0, np.zeros(3), np.eye(3)
        if kind == OBJECT.XBODY:
            return number, d.xpos[number], d.xmat[number]
        if kind == OBJECT.BODY:
            return number, d.xipos[number], d.ximat[number]
        if kind == OBJECT.GEOM:
            return model.geom_bodyid[number], d.geom_xpos[number], d.geom_xmat[number]
        if kind == OBJECT.SITE:
            return model.site_bodyid[number], d.site_xpos[number], d.site_xmat[number]
        return model.cam_bodyid[number], self.cameras.cam_xpos[number], self.cameras.cam_xmat[number]

    def orientation(self, kind: int, number: int):
        """Orientation of an object as a quaternion, fixed to its body also for cameras."""
        if number < 0:
            return IDENTITY
        if kind == OBJECT.XBODY:
            return self.d.xquat[number]
        names = {OBJECT.BODY: "body_iquat", OBJECT.GEOM: "geom_quat", OBJECT.SITE: "site_quat"}
        body = self.frame(kind, number)[0]
        return multiply(self.d.xquat[body], self.number(names.get(kind, "cam_quat"))[number])

    def object_of(self, sensor: int):
        """Type and number of the object that a sensor is attached to."""
        return int(self.model.sensor_objtype[sensor]), int(self.model.sensor_objid[sensor])

    def reference_of(self, sensor: int):
        """Type and number of the frame that a sensor measures in."""
        return int(self.model.sensor_reftype[sensor]), int(self.model.sensor_refid[sensor])

    def velocity(self, kind: int, number: int):
        """Angular velocity and velocity of an object in the world."""
        body, position, _ = self.frame(kind, number)
        spin, velocity = (x[body] for x in self.velocities)
        return spin, velocity + cross_each(spin, position - self.d.xpos[body])

    def acceleration(self, kind: int, number: int):
        """Angular acceleration, and acceleration less gravity, of an object in the world; 0 if that does not move."""
        body, position, _ = self.frame(kind, number)
        if not find_carriers(self.model)[body].any():  # there C MuJoCo leaves out gravity
            return np.zeros(3), np.zeros(3)
        arm, spin = position - self.d.xpos[body], self.velocities[0][body]
        rate, acceleration = (x[body] for x in self.accelerations)
        turning = cross_each(rate, arm) + cross_each(spin, cross_each(spin, arm))
        return rate, acceleration + turning

    @functools.cached_property
    def momenta(self):
        """Momentum of each body, its angular momentum about its centre of mass."""
        spin, velocity = self.velocities
        velocity = velocity + cross_each(spin, self.d.xipos - self.d.xpos)
        return self.number("body_mass")[:, None] * velocity, self._inertia_times(spin)

    def _inertia_times(self, spin):
        """R I R' spin for each body."""
        local = rotate_each(self.d.ximat.swapaxes(-1, -2), spin)
        return rotate_each(self.d.ximat, self.number("body_inertia") * local)

    @functools.cached_property
    def tendon_forces(self):
        """All forces along the tendons, less what accelerates their armature [ntendon]."""
        model, mx, d, smooth = self.model, self.mx, self.d, self.smooth
        force = find_tendon_forces(model, mx, d, smooth)
        for actuator in np.nonzero(model.actuator_trntype == TRANSMISSION.TENDON)[0]:
            here = np.arange(model.ntendon) == model.actuator_trnid[actuator, 0]
            force = force + here * d.actuator_force[actuator] * self.number("actuator_gear")[actuator, 0]
        force = force + self.reactions.tendons if self.reactions else force
        armature = find_armature(model, mx, "tendon")
        if is_zero(armature):
            return force
        return force - armature * (contract(smooth.tendon_jacobian, d.qacc) + find_tendon_rates(model, d, smooth))

    @functools.cached_property
    def interactions(self):
        """Force and torque about the world's origin by which its joints act on each body and what that carries."""
        spin, (rate, acceleration) = self.velocities[0], self.accelerations
        arm = self.d.xipos - self.d.xpos
        acceleration = acceleration + cross_each(rate, arm) + cross_each(spin, cross_each(spin, arm))
        force = self.number("body_mass")[:, None] * acceleration
        torque = self._inertia_times(rate) + cross_each(spin, self._inertia_times(spin))
        torque = torque + cross_each(self.d.xipos, force)
        return force - self.outer[0], torque - self.outer[1]

    @functools.cached_property
    def outer(self):
        """Force and torque about the world's origin by all but gravity and joints on each body but the world."""
        force = self.d.xfrc_applied[:, :3]
        torque = self.d.xfrc_applied[:, 3:] + cross_each(self.d.xipos, force)
        if len(self.model.wrap_type):
            pull = find_tendon_pulls(self.model, self.d, self.tendon_forces)
            force, torque = force + pull[0], torque + pull[1]
        if self.reactions:
            force, torque = force + self.reactions.wrenches[0], torque + self.reactions.wrenches[1]
        moves = np.arange(self.model.nbody)[:, None] > 0
        return jnp.where(moves, force, 0.0), jnp.where(moves, torque, 0.0)


# --- positions --------------------------------------------------------------------------------------------------------


def _read_magnetometer(reader: _Reader, sensor: int):
    return rotate_back(reader.frame(*reader.object_of(sensor))[2], reader.number("opt.magnetic"))


def _read_projection(reader: _Reader, sensor: int):
    """Pixel of a site in a camera's image."""
    model, camera = reader.model, int(reader.model.sensor_refid[sensor])
    width, height = model.cam_resolution[camera]
    size = model.cam_sensorsize[camera]
    focal = np.full(2, 0.5 * height) / jnp.tan(reader.number("cam_fovy")[camera] * np.pi / 360.0)
    if size.all():
        focal = reader.number("cam_intrinsic")[camera, :2].astype(float) / size * (width, height)
    _, target, _ = reader.frame(*reader.object_of(sensor))
    _, eye, axes = reader.frame(OBJECT.CAMERA, camera)
    x, y, depth = rotate_back(axes, target - eye)
    depth = jnp.where(jnp.abs(depth) < SMALL, jnp.where(depth < 0, -SMALL, SMALL), depth)
    return jnp.stack([0.5 * width - focal[0] * x / depth, 0.5 * height + focal[1] * y / depth])


def _read_frame_position(reader: _Reader, sensor: int):
    _, position, _ = reader.frame(*reader.object_of(sensor))
    _, origin, axes = reader.frame(*reader.reference_of(sensor))
    return rotate_back(axes, position - origin)


def _read_frame_axis(reader: _Reader, sensor: int):
    _, _, axes = reader.frame(*reader.object_of(sensor))
    _, _, reference = reader.frame(*reader.reference_of(sensor))
    return rotate_back(reference, axes[:, reader.model.sensor_type[sensor] - SENSOR.FRAMEXAXIS])


def _read_frame_orientation(reader: _Reader, sensor: int):
    orientation, (kind, number) = reader.orientation(*reader.object_of(sensor)), reader.reference_of(sensor)
    return orientation if number < 0 else multiply(conjugate(reader.orientation(kind, number)), orientation)


def _read_ball_orientation(reader: _Reader, sensor: int):
    begin = reader.model.jnt_qposadr[reader.model.sensor_objid[sensor]]
    return normalize(reader.d.qpos[begin : begin + 4])


def _read_range(reader: _Reader, sensor: int):
    """The distance along the site's z-axis to the first geom that is visible and not of the same body, or -1."""
    model, d, site = reader.model, reader.d, int(reader.model.sensor_objid[sensor])
    origin, direction = d.site_xpos[site], d.site_xmat[site][:, 2]
    distance = jnp.full((), MISS)
    for geom in list_visible_geoms(model, int(model.site_bodyid[site])):
        shape, size = SHAPES[model.geom_type[geom]], reader.number("geom_size")[geom]
        other = find_distance(shape, d.geom_xpos[geom], d.geom_xmat[geom], size, origin, direction)
        distance = jnp.minimum(distance, other)
    return jnp.where(distance < MISS, distance, -1.0)


def list_visible_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """The geoms that a ray from a body can meet."""
    has_material = model.geom_matid >= 0
    alpha = model.geom_rgba[:, 3]
    if model.nmat:
        alpha = np.where(has_material, model.mat_rgba[np.maximum(model.geom_matid, 0), 3], alpha)
    return np.flatnonzero((alpha != 0) & (model.geom_bodyid != body)).tolist()


def _read_inside(reader: _Reader, sensor: int):
    """1 if the object is inside of the site, else 0."""
    model, (kind, number) = reader.model, reader.object_of(sensor)
    site = int(model.sensor_refid[sensor])
    _, point, _ = reader.frame(kind, number)
    if kind == OBJECT.BODY and number > 0 and model.body_mass[number] < SMALL <= model.body_subtreemass[number]:
        point = reader.d.subtree_com[number]
    shape, size = SHAPES[model.site_type[site]], reader.number("site_size")[site]
    return is_inside(shape, reader.d.site_xpos[site], reader.d.site_xmat[site], size, point).astype(float)


def _read_limit(reader: _Reader, sensor: int):
    """How far a limit is exceeded, its rate, or its force; 0 where it does not act."""
    model, kind = reader.model, int(reader.model.sensor_type[sensor])
    is_joint, number = kind in JOINT_LIMITS, _number_of(sensor, reader)
    is_limited = (model.jnt_limited if is_joint else model.tendon_limited)[number]
    if not is_limited or not reader.reactions or is_disabled(model, DISABLED.LIMIT):
        return 0.0
    limit = reader.reactions.find_joint_limit(number) if is_joint else reader.reactions.find_tendon_limit(number)
    return limit[(JOINT_LIMITS if is_joint else TENDON_LIMITS).index(kind)]


def _read_potential_energy(reader: _Reader, sensor: int):
    """-sum m g x, and the springs' energies."""
    d = reader.d
    weight = reader.number("body_mass")[:, None] * reader.gravity
    return -(weight * d.xipos).sum() + _find_spring_energy(reader)


def _find_spring_energy(reader: _Reader):
    """Energy of the springs: integral of x k(x) = k_0 x^2 / 2 + sum_i k_i x^(i + 2) / (i + 2)."""
    model, d = reader.model, reader.d
    if is_disabled(model, DISABLED.SPRING):
        return 0.0
    rest, stiffness, energy = reader.number("qpos_spring"), reader.number("jnt_stiffness"), 0.0
    for joint, (kind, q) in enumerate(zip(model.jnt_type, model.jnt_qposadr, strict=True)):
        higher = reader.number("jnt_stiffnesspoly")[joint]
        shifts = [(d.qpos[q] - rest[q])[None]]
        if kind in (FREE, BALL):
            turned = slice(q + 3 * (kind == FREE), q + 3 * (kind == FREE) + 4)
            shifts = [subtract(normalize(d.qpos[turned]), rest[turned])]
            shifts += [d.qpos[q : q + 3] - rest[q : q + 3]] if kind == FREE else []
        energy = energy + sum(_integrate_spring(stiffness[joint], higher, shift) for shift in shifts)
    for tendon in range(model.ntendon):
        low, high = reader.number("tendon_lengthspring")[tendon]
        shift = jnp.maximum(d.ten_length[tendon] - high, 0.0) + jnp.minimum(d.ten_length[tendon] - low, 0.0)
        coefficient, higher = (reader.number(f"tendon_{name}")[tendon] for name in ("stiffness", "stiffnesspoly"))
        energy = energy + _integrate_spring(coefficient, higher, shift[None])
    return energy


def _integrate_spring(stiffness, higher, shift):
    """Energy of one spring, with |shift| where that has several components."""
    square = (shift * shift).sum()
    energy = 0.5 * stiffness * square
    if not is_zero(higher):
        x = shift[0] if shift.size == 1 else jnp.sqrt(jnp.where(square > 0, square, 1.0)) * (square > 0)
        energy = energy + sum(k * x ** (i + 3) / (i + 3) for i, k in enumerate(higher))
    return energy


# --- velocities -------------------------------------------------------------------------------------------------------


def _read_velocimeter(reader: _Reader, sensor: int):
    which = reader.object_of(sensor)
    return rotate_back(reader.frame(*which)[2], reader.velocity(*which)[1])


def _read_gyro(reader: _Reader, sensor: int):
    which = reader.object_of(sensor)
    return rotate_back(reader.frame(*which)[2], reader.velocity(*which)[0])


def _read_frame_velocity(reader: _Reader, sensor: int):
    """Velocity or angular velocity, relative to the reference frame, which may turn."""
    which, reference = reader.object_of(sensor), reader.reference_of(sensor)
    spin, velocity = reader.velocity(*which)
    if reference[1] >= 0:
        base_spin, base_velocity = reader.velocity(*reference)
        (_, position, _), (_, origin, axes) = reader.frame(*which), reader.frame(*reference)
        velocity = velocity - base_velocity - cross_each(base_spin, position - origin)
        spin, velocity = rotate_back(axes, spin - base_spin), rotate_back(axes, velocity)
    return velocity if reader.model.sensor_type[sensor] == SENSOR.FRAMELINVEL else spin


def _read_ball_velocity(reader: _Reader, sensor: int):
    begin = reader.model.jnt_dofadr[reader.model.sensor_objid[sensor]]
    return reader.d.qvel[begin : begin + 3]


def _read_subtree_velocity(reader: _Reader, sensor: int):
    carried = find_carried(reader.model)[reader.model.sensor_objid[sensor]].astype(float)
    mass = contract(carried, reader.number("body_mass"))
    return contract(carried, reader.momenta[0]) / (mass if not isinstance(mass, float) else max(mass, SMALL))


def _read_subtree_momentum(reader: _Reader, sensor: int):
    """Angular momentum of all that a body carries, about the centre of mass of that."""
    body = reader.model.sensor_objid[sensor]
    carried = find_carried(reader.model)[body].astype(float)
    momentum, own = reader.momenta
    return contract(carried, own + cross_each(reader.d.xipos - reader.d.subtree_com[body], momentum))


def _read_kinetic_energy(reader: _Reader, sensor: int):
    return 0.5 * (reader.d.qvel * contract(reader.smooth.mass, reader.d.qvel)).sum()


# --- accelerations and forces -----------------------------------------------------------------------------------------


def _read_accelerometer(reader: _Reader, sensor: int):
    which = reader.object_of(sensor)
    return rotate_back(reader.frame(*which)[2], reader.acceleration(*which)[1])


def _read_frame_acceleration(reader: _Reader, sensor: int):
    rate, acceleration = reader.acceleration(*reader.object_of(sensor))
    return acceleration if reader.model.sensor_type[sensor] == SENSOR.FRAMELINACC else rate


def _read_force(reader: _Reader, sensor: int):
    """Force or torque between the site's body, with all that it carries, and its parent."""
    site = reader.model.sensor_objid[sensor]
    carried = find_carried(reader.model)[reader.model.site_bodyid[site]].astype(float)
    force, torque = (contract(carried, x) for x in reader.interactions)
    torque = torque - cross_each(reader.d.site_xpos[site], force)
    wanted = force if reader.model.sensor_type[sensor] == SENSOR.FORCE else torque
    return rotate_back(reader.d.site_xmat[site], wanted)


def _read_outer_forces(reader: _Reader):
    """cfrc_ext: torque about the centre of mass of the body's tree, and force [nbody, 6]."""
    force, torque = reader.outer
    center = reader.d.subtree_com[reader.model.body_rootid]
    return jnp.concatenate([torque - cross_each(center, force), force], 1)


def _read_tendon_force(reader: _Reader, sensor: int):
    model = reader.model
    here = (model.actuator_trntype == TRANSMISSION.TENDON) & (model.actuator_trnid[:, 0] == model.sensor_objid[sensor])
    return contract(here.astype(float), reader.d.actuator_force)


def _number_of(sensor: int, reader: _Reader) -> int:
    return int(reader.model.sensor_objid[sensor])


READERS = {
    getattr(SENSOR, name): read
    for name, read in {
        "TOUCH": read_touch,
        "CONTACT": read_contact,
        "RANGEFINDER": _read_range,
        "INSIDESITE": _read_inside,
        **dict.fromkeys(("JOINTLIMITPOS", "JOINTLIMITVEL", "JOINTLIMITFRC"), _read_limit),
        **dict.fromkeys(("TENDONLIMITPOS", "TENDONLIMITVEL", "TENDONLIMITFRC"), _read_limit),
        "MAGNETOMETER": _read_magnetometer,
        "CAMPROJECTION": _read_projection,
        "JOINTPOS": lambda r, s: r.d.qpos[r.model.jnt_qposadr[_number_of(s, r)]],
        "TENDONPOS": lambda r, s: r.d.ten_length[_number_of(s, r)],
        "ACTUATORPOS": lambda r, s: r.d.actuator_length[_number_of(s, r)],
        "BALLQUAT": _read_ball_orientation,
        "FRAMEPOS": _read_frame_position,
        "FRAMEQUAT": _read_frame_orientation,
        "FRAMEXAXIS": _read_frame_axis,
        "FRAMEYAXIS": _read_frame_axis,
        "FRAMEZAXIS": _read_frame_axis,
        "SUBTREECOM": lambda r, s: r.d.subtree_com[_number_of(s, r)],
        "E_POTENTIAL": _read_potential_energy,
        "E_KINETIC": _read_kinetic_energy,
        "CLOCK": lambda r, s: r.d.time,
        "VELOCIMETER": _read_velocimeter,
        "GYRO": _read_gyro,
        "JOINTVEL": lambda r, s: r.d.qvel[r.model.jnt_dofadr[_number_of(s, r)]],
        "TENDONVEL": lambda r, s: r.smooth.tendon_velocity[_number_of(s, r)],
        "ACTUATORVEL": lambda r, s: r.smooth.actuator_velocity[_number_of(s, r)],
        "BALLANGVEL": _read_ball_velocity,
        "FRAMELINVEL": _read_frame_velocity,
        "FRAMEANGVEL": _read_frame_velocity,
        "SUBTREELINVEL": _read_subtree_velocity,
        "SUBTREEANGMOM": _read_subtree_momentum,
        "ACCELEROMETER": _read_accelerometer,
        "FORCE": _read_force,
        "TORQUE": _read_force,
        "ACTUATORFRC": lambda r, s: r.d.actuator_force[_number_of(s, r)],
        "JOINTACTFRC": lambda r, s: r.d.qfrc_actuator[r.model.jnt_dofadr[_number_of(s, r)]],
        "TENDONACTFRC": _read_tendon_force,
        "FRAMELINACC": _read_frame_acceleration,
        "FRAMEANGACC": _read_frame_acceleration,
    }.items()
}
