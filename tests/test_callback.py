"""C MuJoCo's step from compiled programs: its very bits, whoever calls at the same time; divergence is to be seen."""

import copy
import functools
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import optax
import pytest
from processes import outcome

import envs
from envs.physics import PHYSICS, MujocoModelError, compile_step
from envs.physics.callback import Simulations
from envs.physics.fields import INPUTS, JACOBIANS, OUTPUTS, find_types
from jaxpg.actor_critic import actor_critic
from jaxpg.estimators import gae
from jaxpg.methods import td
from jaxpg.networks import mlp_networks
from jaxpg.shards import AXIS, shard
from jaxpg.training import train_scan
from jaxpg.vector_env import vectorize

RICH = """<mujoco><option density="1.2" viscosity="0.1"/>
<worldbody><geom type="plane" size="5 5 1"/><site name="wall" pos="0 0 1"/><camera/>
<body name="hand" mocap="true"><geom size="0.1" contype="0" conaffinity="0"/></body>
<body name="box" pos="0 0 0.3"><freejoint/><geom type="box" size="0.1 0.2 0.1"/><site name="middle"/>
  <body pos="0.3 0 0" gravcomp="0.5"><geom type="capsule" size="0.05 0.1"/><site name="tip"/>
  <joint name="j" axis="0 1 0" range="-1 1" limited="true" frictionloss="0.1" stiffness="1" damping="0.1"/></body>
</body>
<body name="ball" pos="1 0 0.1"><freejoint/><geom size="0.1"/></body></worldbody>
<tendon><spatial name="t" range="0 0.8" limited="true"><site site="wall"/><site site="tip"/></spatial></tendon>
<equality><weld body1="hand" body2="ball" active="false"/></equality>
<actuator><general joint="j" dyntype="filter" dynprm="0.1"/><motor joint="j" ctrlrange="-1 1" ctrllimited="true"/>
<motor tendon="t"/></actuator>
<sensor><jointpos joint="j"/><accelerometer site="tip"/><touch site="middle"/><subtreelinvel body="box"/></sensor>
</mujoco>"""
STIFF = models.chain(models.pole(), '<general joint="pole" biastype="affine" biasprm="0 -1e7 0" gainprm="1e7"/>')


def rich_inputs(model, number, seed=0):
    """Random values of all inputs, `[number, ...]`, float64."""
    random, data = np.random.default_rng(seed), mujoco.MjData(model)
    values = {name: np.array([np.array(getattr(data, name), float)] * number) for name in INPUTS}
    for name, scale in {"qpos": 0.3, "qvel": 1, "act": 1, "ctrl": 1, "qfrc_applied": 1, "mocap_pos": 1}.items():
        values[name] += scale * random.normal(size=values[name].shape)
    values["time"][:] = random.uniform(size=number)
    values["eq_active"][:] = random.integers(0, 2, (number, 1))
    return values


def read_field(model, data, name):
    """A field as a caller of C MuJoCo gets it."""
    if name in JACOBIANS:
        kind, which = name.split("_jac")
        compute = {"site": mujoco.mj_jacSite, "body": mujoco.mj_jacBody}[kind]
        jacobians = np.zeros((getattr(model, f"n{kind}"), 2, 3, model.nv))
        for number, (jacp, jacr) in enumerate(jacobians):
            compute(model, data, jacp, jacr, number)
        return jacobians[:, "pr".index(which)]
    return np.array(getattr(data, name), float)


def by_loop(model, values, num_substeps, outputs):
    """The same by `mj_step`, each environment in data of its own; cfrc_ext of the velocities of the other fields."""
    model = copy.copy(model)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    results = []
    for place in range(len(values["qpos"])):
        data = mujoco.MjData(model)
        for name, x in values.items():
            setattr(data, name, x[place])
        for _ in range(num_substeps):
            before = data.qvel.copy()
            mujoco.mj_step(model, data)
        other = copy.copy(data)
        other.qvel[:] = before
        mujoco.mj_rnePostConstraint(model, other)
        data.cfrc_ext[:] = other.cfrc_ext
        results.append([read_field(model, data, name) for name in outputs])
    return [np.stack(x).reshape(len(x), -1) for x in zip(*results, strict=True)]


def test_every_output_is_mujocos_own():
    """To the last bit in float64, with contacts, limits, tendons, equalities, activations and sensors."""
    model = mujoco.MjModel.from_xml_string(RICH)
    values = rich_inputs(model, 20)
    with jax.enable_x64(True):
        step = jax.jit(jax.vmap(compile_step(model, 3, inputs=INPUTS, outputs=OUTPUTS, physics="mujoco")))
        arguments = [x.astype(bool) if name == "eq_active" else x for name, x in values.items()]
        for name, ours, true in zip(OUTPUTS, step(*arguments), by_loop(model, values, 3, OUTPUTS), strict=True):
            np.testing.assert_array_equal(np.reshape(ours, (20, -1)), true, err_msg=name)


def test_nothing_is_left_of_others():
    """The outputs of an environment are the same beside others, in another place, and after other calls."""
    model = mujoco.MjModel.from_xml_string(RICH)
    arrays = list(rich_inputs(model, 30).values())
    arrays[INPUTS.index("qpos")][3, 0] = np.nan
    order = np.random.default_rng(1).permutation(30)
    simulations = Simulations(model, 2, INPUTS, OUTPUTS)

    def step(places):
        return simulations.compute(find_types(model, OUTPUTS), *(x[places] for x in arrays))

    for name, here, elsewhere in zip(OUTPUTS, step(np.arange(30)), step(order), strict=True):
        np.testing.assert_array_equal(here[order], elsewhere, err_msg=name)


def test_threads_that_call_at_once_get_what_they_get_alone():
    step = jax.jit(jax.vmap(compile_step(envs.make("arm").model, 5, physics="mujoco")))
    batches = [
        [jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, (size, 2)), jnp.float32) for _ in range(3)]
        for seed, size in enumerate((64, 64, 96))
    ]
    alone = [step(*batch) for batch in batches]

    def differing(number):
        both = (zip(step(*batches[number]), alone[number], strict=True) for _ in range(50))
        return sum(not np.array_equal(ours, true) for pairs in both for ours, true in pairs)

    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(differing, range(3))) == [0, 0, 0]


LARGE = """
import jax, jax.numpy as jnp
jax.config.update("jax_num_cpu_devices", 2)
import envs
from envs.physics import compile_step
step = jax.vmap(compile_step(envs.make("arm").model, physics="mujoco"))
mesh = jax.sharding.Mesh(jax.devices(), ("shards",))
def play(state):
    def turn(state, _):
        qpos, qvel = step(*state, jnp.ones_like(state[0]))
        return (qpos, qvel - jax.lax.pmean(qvel.mean(), "shards")), None
    return jax.lax.scan(turn, state, length=20)[0]
where = jax.sharding.PartitionSpec("shards")
state = (jnp.zeros((60_000, 2)),) * 2
print(jax.jit(jax.shard_map(play, mesh=mesh, in_specs=where, out_specs=where, check_vma=False))(state)[0].shape)
"""


def test_large_batches_on_two_devices_end():
    """Copies that the compiled program's own threads have to make would wait for these for ever."""
    ended = subprocess.run([sys.executable, "-c", LARGE], capture_output=True, text=True, timeout=100, check=False)
    assert ended.stdout == "(60000, 2)\n", ended.stderr


def test_axes_of_several_maps_are_environments():
    """Two seeds of three environments, with one control for all: each as it is alone."""
    model = envs.make("arm").model
    step = compile_step(model, physics="mujoco")
    qpos, qvel = np.random.default_rng(0).uniform(-1, 1, (2, 2, 3, 2)).astype(np.float32)
    ctrl = jnp.asarray([0.5, -1.0])
    over_envs = jax.vmap(step, in_axes=(0, 0, None))
    together = jax.jit(jax.vmap(over_envs, in_axes=(0, 0, None)))(qpos, qvel, ctrl)
    for place in np.ndindex(2, 3):
        for ours, alone in zip(together, step(qpos[place], qvel[place], ctrl), strict=True):
            np.testing.assert_array_equal(ours[place], alone)
    assert [x.shape for x in jax.vmap(step)(*[jnp.zeros((0, 2))] * 3)] == [(0, 2), (0, 2)]


# --- equal runs have equal bits ---------------------------------------------------------------------------------------


@functools.cache
def training(num_shards):
    """Parameters after some updates of 32 arms that C MuJoCo moves, from a key."""
    env, several = envs.make("arm", physics="mujoco"), num_shards > 1
    batch, networks = vectorize(env, 32 // num_shards, 20), mlp_networks(env.observation_size, env.action_size, (8,))
    optimizer, axis_name = optax.adam(0.01), AXIS if several else None
    algorithm = actor_critic(batch, networks, optimizer, td(0.9, 5, gae(0.9)), axis_name=axis_name)
    algorithm = shard(algorithm, num_shards, jax.devices()) if several else algorithm
    return jax.jit(lambda key: jax.tree.leaves(train_scan(algorithm, key, num_updates=20)[0].params))


def digest(num_shards, seed=0):
    return b"".join(np.asarray(x).tobytes() for x in training(num_shards)(jax.random.key(seed)))


def test_two_shards_learn_the_same_each_time():
    """Their devices call MuJoCo at the same time."""
    assert len({digest(2) for _ in range(10)}) == 1


def test_two_seeds_learn_the_same_each_time():
    """As do groups of agents in threads of their own."""
    alone = [digest(1, seed) for seed in (0, 1)]
    assert alone[0] != alone[1]
    with ThreadPoolExecutor(2) as threads:
        for _ in range(5):
            assert list(threads.map(lambda seed: digest(1, seed), (0, 1))) == alone


TINY = ("env=arm", "env.physics=mujoco", "env.episode_length=8", "num_envs=8", "num_steps=8", "total_steps=640")
TINY += ("algo.epochs=1", "algo.minibatches=1", "log_interval=64", "eval_interval=320", "eval_episodes=2")


@pytest.mark.study
@pytest.mark.parametrize(
    "options",
    [("algo.num_shards=2",), ("num_seeds=2", "algo.num_shards=1"), ("sweep.algo.gamma=[0.8,0.9]", "algo.num_shards=1")],
    ids=["shards", "seeds", "sweep"],
)
def test_twenty_equal_commands_end_with_equal_bits(options, command, tmp_path):
    ends = set()
    for number in range(20):
        folder = tmp_path / str(number)
        ended = command("train", *TINY, *options, "report=false", f"run_dir={folder}")
        assert ended.returncode == 0, ended.stderr
        ends.add(json.dumps(outcome(folder)))
    assert len(ends) == 1


# --- divergence -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in INPUTS if name != "eq_active"])
def test_a_nan_is_seen_in_its_environment_and_no_other(name):
    model = mujoco.MjModel.from_xml_string(RICH)
    values = rich_inputs(model, 4)
    step = jax.jit(jax.vmap(compile_step(model, 2, inputs=INPUTS, outputs=("qpos", "qvel", "time"), physics="mujoco")))
    sound = step(*in_float32(values))
    values[name].reshape(4, -1)[2, -1] = np.nan
    for ours, true in zip(step(*in_float32(values)), sound, strict=True):
        assert np.isnan(ours[2]).all()
        np.testing.assert_array_equal(np.delete(ours, 2, 0), np.delete(true, 2, 0))


def in_float32(values):
    return [jnp.asarray(x, bool if name == "eq_active" else jnp.float32) for name, x in values.items()]


@functools.cache
def arm_steps(physics):
    """Control steps of three arms."""
    return jax.jit(jax.vmap(compile_step(envs.make("arm").model, 5, physics=physics)))


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("bad", ["nan position", "nan control", "fast"])
def test_what_diverges_is_seen_whatever_the_physics(physics, bad):
    qpos, qvel, ctrl = np.full((3, 3, 2), 0.5, np.float32)
    array = {"nan position": qpos, "nan control": ctrl, "fast": qvel}[bad]
    array[1, 0] = 1e12 if bad == "fast" else np.nan
    results = arm_steps(physics)(qpos, qvel, ctrl)
    sane = np.all([(np.abs(x) <= mujoco.mjMAXVAL).all(1) for x in results], 0)
    assert sane.tolist() == [True, False, True]


def test_a_motion_that_diverges_does_not_begin_anew():
    """MuJoCo by itself restarts it within the step; without a restart it is NaN from there on."""
    step = jax.jit(compile_step(mujoco.MjModel.from_xml_string(STIFF), physics="mujoco"))
    state, sane = (jnp.asarray([0.1]), jnp.zeros(1)), []
    for _ in range(12):
        state = step(*state, jnp.asarray([0.5]))
        sane.append(bool(np.isfinite(np.concatenate(state)).all()))
    assert sane == sorted(sane, reverse=True)
    assert sane[0]
    assert not sane[-1]


def test_controls_are_taken_as_mjx_takes_them():
    """Beyond its range a control is the end of it, also where it is infinite; without a range MuJoCo takes none."""
    ctrl = np.array([[np.inf, -1e12], [2.0, -2.0], [-np.inf, 0.0]], np.float32)
    ours, theirs = (arm_steps(physics)(*np.zeros((2, 3, 2), np.float32), ctrl) for physics in ("mujoco", "mjx"))
    np.testing.assert_allclose(np.stack(ours), np.stack(theirs), rtol=1e-5)
    free = compile_step(models.make("double pendulum"), physics="mujoco")
    assert np.isnan(np.stack(free(np.zeros(2), np.zeros(2), np.array([1e12])))).all()


def test_divergence_is_not_printed_nor_written(tmp_path, monkeypatch, capfd):
    """MuJoCo's default leaves a file in the working directory. The user's own warnings still arrive."""
    monkeypatch.chdir(tmp_path)
    step = jax.jit(jax.vmap(compile_step(mujoco.MjModel.from_xml_string(STIFF), 5, physics="mujoco")))
    for position, speed, control in ((jnp.nan, 0, 0), (0, 1e12, 0), (0, 0, jnp.nan), (0.1, 0, 0.5)):
        step(*(jnp.full((2, 1), x) for x in (position, speed, control)))
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
    model, data = models.make("cart-pole"), None
    data = mujoco.MjData(model)
    data.qvel[0] = 1e12
    mujoco.mj_step(model, data)
    assert "unstable" in capfd.readouterr().err


# --- models that differ -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "field", ["body_mass", "body_inertia", "dof_damping", "dof_armature", "actuator_gear", "opt.gravity"]
)
def test_environments_may_differ_in_their_models(field):
    """Each is stepped as C MuJoCo steps a model with the field set, all else as it was."""
    model = models.make("damping, stiffness, armature")
    random = np.random.default_rng(0)
    value = np.array(model.opt.gravity if field == "opt.gravity" else getattr(model, field))
    fields = value * random.uniform(0.5, 2, (5, *value.shape))
    states = models.random_states(model, 5)
    inputs = ("qpos", "qvel", "ctrl", "model." + field)
    with jax.enable_x64(True):
        ours = jax.jit(jax.vmap(compile_step(model, inputs=inputs, physics="mujoco")))(*states, fields)
    for place in range(5):
        if field == "opt.gravity":
            model.opt.gravity = fields[place]
        else:
            getattr(model, field)[...] = fields[place]
        true = models.by_mujoco(model, [x[place : place + 1] for x in states])
        for mine, other in zip(ours, true, strict=True):
            np.testing.assert_array_equal(mine[place], other[0])


FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "jnt_axis", "jnt_pos", "dof_damping", "dof_armature")
FIELDS += ("actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "site_pos", "geom_quat", "opt.timestep")


def test_models_differ_as_they_do_by_mjx():
    """In all fields at once, also in frames that coincide when the model is compiled, where MuJoCo has shortcuts."""
    child = '<body pos="0.3 0 0"><joint axis="1 1 0"/><geom type="box" size="0.2 0.1 0.1"/><site name="s"/></body>'
    servo = '<position joint="pole" kp="10" ctrlrange="-1 1"/>'
    model = mujoco.MjModel.from_xml_string(models.chain(models.pole(child), servo))
    random, names = np.random.default_rng(0), tuple("model." + name for name in FIELDS)
    with jax.enable_x64(True):
        fields = [model.opt.timestep if x == "opt.timestep" else getattr(model, x) for x in FIELDS]
        fields = [np.asarray(x) + 0.1 * np.abs(x) + 0.01 * random.uniform(size=np.shape(x)) for x in fields]
        fields = [
            x / np.linalg.norm(x, axis=-1, keepdims=True) if "quat" in name or "axis" in name else x
            for name, x in zip(FIELDS, fields, strict=True)
        ]
        for name, x in zip(FIELDS, fields, strict=True):
            if name.startswith("body"):
                x[0] = getattr(model, name)[0]  # the world's
        state = random.normal(size=(2, model.nv))
        outputs = ("qpos", "qvel", "site_xpos", "site_xmat", "geom_xmat", "ximat", "xipos")
        ours, theirs = (
            jax.jit(compile_step(model, 2, inputs=("qpos", "qvel", "ctrl", *names), outputs=outputs, physics=physics))(
                *state, jnp.asarray([0.5]), *fields
            )
            for physics in ("mujoco", "mjx")
        )
    for name, mine, other in zip(outputs, ours, theirs, strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-9, err_msg=name)


def test_geoms_that_are_moved_or_enlarged_touch():
    """MuJoCo looks for contacts by boxes and spheres around geoms, which stay as they were."""
    ground = "".join(f'<geom type="box" size="1 1 .1" pos="0 0 {-0.1 - 3 * x}"/>' for x in range(4))
    balls = "".join(f'<geom size=".1" pos="{x} 0 0"/>' for x in range(4))
    body = f'<body pos="-1 0 .5"><freejoint/>{balls}</body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{ground}{body}</worldbody></mujoco>")
    lower = np.array(model.geom_pos)
    lower[5, 2] -= 0.5
    larger = np.array(model.geom_size)
    larger[7] *= 12
    for field, other in {"geom_pos": lower, "geom_size": larger}.items():
        step = compile_step(model, inputs=("qpos", "qvel", "model." + field), outputs=("qvel",), physics="mujoco")
        (velocity,) = jax.vmap(step, (None, None, 0))(
            model.qpos0, np.zeros(6), np.stack([getattr(model, field), other])
        )
        assert velocity[0, 2] == pytest.approx(-9.81 * model.opt.timestep, rel=1e-4)
        assert abs(velocity[1] - velocity[0]).max() > 0.1


def test_inertial_frames_that_cannot_differ_are_refused():
    """A body alone in space has a diagonal matrix of inertia, of which MuJoCo stores no more unless it is told to."""
    alone = models.chain('<body name="ball"><freejoint/><geom size="0.1"/></body>')
    inputs = ("qpos", "qvel", "model.body_ipos")
    with pytest.raises(
        ValueError, match=r"^model\.body_ipos: .* it cannot differ .* body 'ball' needs simple=\"false\""
    ):
        compile_step(mujoco.MjModel.from_xml_string(alone), inputs=inputs, physics="mujoco")
    model = mujoco.MjModel.from_xml_string(alone.replace('name="ball"', 'name="ball" simple="false"'))
    moved = compile_step(model, inputs=inputs, outputs=("xipos",), physics="mujoco")
    (centre,) = moved(model.qpos0, np.zeros(6), np.array([[0, 0, 0], [0.1, 0, 0]]))
    np.testing.assert_allclose(centre[1], [0.1, 0, 0], atol=1e-6)


def test_masses_that_would_be_ignored_are_refused():
    """MuJoCo takes the matrix of inertia of a body alone in space from `dof_M0`."""
    model = mujoco.MjModel.from_xml_string(models.chain('<body name="ball"><freejoint/><geom size="0.1"/></body>'))
    for field in ("model.body_mass", "model.dof_armature"):
        with pytest.raises(ValueError, match=rf"^{field}: C MuJoCo needs model.dof_M0 beside it, as body 'ball'"):
            compile_step(model, inputs=("qpos", "qvel", field), physics="mujoco")


def test_a_model_that_cannot_be_batched_is_named():
    sleepy = models.chain(models.pole(), option='<option><flag sleep="enable"/></option>')
    with pytest.raises(MujocoModelError, match=r"mujoco\.batch cannot step it: .*sleep"):
        compile_step(mujoco.MjModel.from_xml_string(sleepy), physics="mujoco")
