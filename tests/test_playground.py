"""MuJoCo Playground's environments: the adapter, on a stand-in, and the real ones where they are installed."""

import importlib.util
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct
from mujoco import mjx

import envs
from envs.hints import pip_install
from envs.options import OptionError
from envs.playground_env import Playground
from jaxpg.evaluation import evaluate
from jaxpg.rollout import rollout
from jaxpg.vector_env import vectorize


@struct.dataclass
class State:
    """The fields of Playground's."""

    data: jax.Array
    obs: dict | jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class Hopper:
    """Has Playground's ways: several observations, of which its step reads the last, keys and counters in the info."""

    action_size = 1

    def reset(self, rng):
        rng, key = jax.random.split(rng)
        position = jax.random.uniform(key)
        info = {"rng": rng, "steps": jnp.zeros((), jnp.int32)}
        return State(
            position, self.observe(position, 0.0), jnp.zeros(()), jnp.zeros(()), {"height": jnp.zeros(())}, info
        )

    def step(self, state, action):
        position = state.data + action[0]
        state.info["steps"] += 1
        obs = self.observe(position, state.obs["state"][0])
        metrics = {"height": position}
        return state.replace(data=position, obs=obs, reward=position, done=1.0 * (position > 2), metrics=metrics)

    def observe(self, position, before):
        return {"state": jnp.stack([position, before * jnp.ones(())]), "privileged_state": jnp.zeros(5)}


def hop(obs):
    return jnp.full((len(obs), 1), 0.25)


def hopping(obs, key):
    return hop(obs), hop(obs)


def test_the_entry_state_is_what_is_observed():
    env = Playground(Hopper())
    assert (env.observation_size, env.action_size) == (2, 1)
    state = env.reset(jax.random.key(0))
    after = env.step(state, jnp.array([0.5]))
    np.testing.assert_allclose(after.obs, [state.obs[0] + 0.5, state.obs[0]])


def test_no_keys_are_carried():
    """A checkpoint of numbers holds the whole state."""
    state = Playground(Hopper()).reset(jax.random.key(0))
    assert all(leaf.dtype in (np.float32, np.int32, np.uint32) for leaf in jax.tree.leaves(state))


def test_one_observation_is_left_as_it_is():
    class Plain(Hopper):
        def reset(self, rng):
            state = super().reset(rng)
            return state.replace(obs=state.obs["state"])

    assert Playground(Plain()).reset(jax.random.key(0)).obs.shape == (2,)


def test_rollouts_have_its_ends_and_the_time_limit_apart():
    """Starts below 0.25 reach the limit of seven steps before the height of 2, the others are done by then."""
    vector = vectorize(Playground(Hopper()), 8, 7)
    start = vector.reset(jax.random.key(0))
    _, steps = rollout(hopping, vector.step, start, jax.random.key(1), 7)
    early = np.asarray(start.obs[:, 0]) + 7 * 0.25 > 2
    assert 0 < early.sum() < 8
    np.testing.assert_array_equal(steps.terminated.sum(axis=0), early)
    np.testing.assert_array_equal(steps.truncated.sum(axis=0), ~early)


def test_evaluations_have_its_metrics():
    env = Playground(Hopper())
    episodes = evaluate(env, hop, jax.random.split(jax.random.key(0), 4), 3)
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4)).obs[:, 0]
    np.testing.assert_allclose(episodes.metrics["height"], starts + 0.75, rtol=1e-6)
    np.testing.assert_allclose(episodes.episode_return, 3 * starts + 1.5, rtol=1e-6)


ROD = """<mujoco><option timestep="0.01"/><worldbody><body name="rod"><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 .5" size=".02" contype="0" conaffinity="0"/><site name="tip" pos="0 0 .5"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator><sensor><velocimeter site="tip"/></sensor></mujoco>"""


class Rod:
    """An environment in Playground's way: it reads a pose and a sensor, and pushes the rod at random."""

    action_size, n_substeps = 1, 3

    def __init__(self):
        self.mj_model, self.mjx_model = mujoco.MjModel.from_xml_string(ROD), None

    def reset(self, rng):
        qpos = jax.random.uniform(rng, (1,), minval=-1)
        data = mjx_env.make_data(self.mj_model, qpos=qpos, qvel=jnp.ones(1), impl="jax", njmax=3)
        return self.observe(mjx.forward(self.mjx_model, data), {"push": 10.0 * qpos[0]})

    def step(self, state, action):
        data = state.data.replace(xfrc_applied=jnp.zeros((2, 6)).at[1, 0].set(state.info["push"]), time=0.0)
        return self.observe(mjx_env.step(self.mjx_model, data, action, self.n_substeps), state.info)

    def observe(self, data, info):
        obs = jnp.concatenate([data.site_xpos[0], data.sensordata, data.qpos, data.qvel])
        return State(data, obs, data.qpos[0] ** 2, 1.0 * (data.qvel[0] > 50), {}, info)


class Seeing(Rod):
    """Reads something that only MJX has."""

    def observe(self, data, info):
        return super().observe(data.replace(qvel=data.qvel + data.contact.dist.sum()), info)


mjx_env = types.ModuleType("mujoco_playground._src.mjx_env")


@pytest.fixture
def functions(monkeypatch):
    """The module whose functions Playground's environments call; those of this one are never called."""
    for name in ("make_data", "step"):
        monkeypatch.setattr(mjx_env, name, name, raising=False)
    for name, content in (("mujoco_playground", {}), ("mujoco_playground._src", {"mjx_env": mjx_env})):
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    before = mjx.forward
    yield
    assert (mjx_env.make_data, mjx_env.step, mjx.forward) == ("make_data", "step", before)


def play_rod(qpos, actions):
    """The observations that C MuJoCo gives, from the reset on."""
    model = mujoco.MjModel.from_xml_string(ROD)
    data = mujoco.MjData(model)
    data.qpos, data.qvel = qpos, 1.0
    mujoco.mj_forward(model, data)

    def observe():
        return np.concatenate([data.site_xpos[0], data.sensordata, data.qpos, data.qvel])

    yield observe()
    data.xfrc_applied[1, 0] = 10.0 * qpos
    for action in actions:
        data.ctrl = action
        mujoco.mj_step(model, data, Rod.n_substeps)
        yield observe()


@pytest.mark.parametrize("physics", ["scalar", "mujoco"])
def test_environments_step_as_by_c_mujoco(functions, physics):
    """Observations after a reset, and after steps under an action, a push and three substeps."""
    actions = np.array([[1.0], [-0.5], [0.2]])
    with jax.enable_x64(True):
        env = Playground(Rod(), physics)
        state = jax.jit(env.reset)(jax.random.key(0))
        qpos = float(state.pipeline_state.data.qpos[0])
        observed = [state.obs]
        for action in actions:
            state = jax.jit(env.step)(state, action)
            observed.append(state.obs)
    np.testing.assert_allclose(observed, list(play_rod(qpos, actions)), atol=1e-12)


def test_the_data_has_what_is_used_and_no_more(functions):
    data = jax.eval_shape(Playground(Rod(), "scalar").reset, jax.random.key(0)).pipeline_state.data
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(data)]
    names = ["ctrl", "qacc_warmstart", "qpos", "qvel", "sensordata", "site_xpos", "time", "xfrc_applied"]
    assert paths == [f".{name}" for name in names]


def test_what_only_mjx_has_is_one_line(functions):
    with pytest.raises(OptionError, match=r"^Seeing reads data.contact, which only MJX has: env.physics=mjx$"):
        Playground(Seeing(), "scalar")


def test_a_mistake_in_an_environment_is_not_hidden(functions):
    class Wrong(Rod):
        def observe(self, data, info):
            return self.nothing

    with pytest.raises(AttributeError, match="nothing"):
        Playground(Wrong(), "scalar")


def test_a_batch_of_them_is_trained_as_any_other(functions):
    vector = vectorize(Playground(Rod(), "scalar"), 3, 4)
    start = vector.reset(jax.random.key(0))
    _, steps = rollout(hopping, vector.step, start, jax.random.key(1), 4)
    np.testing.assert_array_equal(steps.truncated[:, 0], [0, 0, 0, 1])
    assert len(np.unique(steps.obs[:, :, 0])) == 12


@pytest.fixture
def playground(monkeypatch):
    """A package of that name, with one environment; what loading it raises is what `broken` holds."""
    broken = []

    def load(name, config_overrides):
        assert config_overrides == {"impl": "jax"}
        if broken:
            raise broken[0]
        return Hopper()

    package = types.ModuleType("mujoco_playground")
    package.registry = types.SimpleNamespace(ALL_ENVS=("HopperHop", "CartpoleBalance"), load=load)
    package.__spec__ = importlib.util.spec_from_loader("mujoco_playground", None)
    monkeypatch.setitem(sys.modules, "mujoco_playground", package)
    return broken


def complaint(**options):
    with pytest.raises(OptionError) as error:
        envs.make("playground", **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_made_by_name(playground):
    assert isinstance(envs.make("playground", name="HopperHop", physics="mjx").unwrapped, Hopper)


def test_unknown_names_are_answered_with_the_nearest(playground):
    assert complaint(name="HoperHop") == "unknown Playground environment 'HoperHop': did you mean 'HopperHop'?"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (subprocess.CalledProcessError(128, ["git", "clone"]), "could not download"),
        (FileNotFoundError(2, "No such file or directory", "git"), "could not download"),
        (AttributeError("'MjSpec' object has no attribute 'find_body'"), "does not work with this release"),
    ],
)
def test_what_cannot_be_made_is_one_line(playground, error, words):
    playground.append(error)
    message = complaint(name="HopperHop")
    assert message.startswith("env.name=HopperHop: ")
    assert words in message


def test_a_missing_package_is_one_line(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert complaint() == f"env=playground needs MuJoCo Playground: {pip_install('playground')}"


def test_the_real_one_moves_by_the_equations_as_by_mjx():
    pytest.importorskip("mujoco_playground", reason="pip install playground")

    def play(physics):
        env = envs.make("playground", physics=physics)
        state = env.reset(jax.random.key(0))
        return jax.lax.scan(lambda state, action: (env.step(state, action),) * 2, state, jnp.ones((5, 1)))[1].obs

    np.testing.assert_allclose(play("scalar"), play("mjx"), atol=1e-6)


def test_the_real_one_balances_for_a_moment():
    pytest.importorskip("mujoco_playground", reason="pip install playground")
    vector = vectorize(envs.make("playground"), 2, 3)

    @jax.jit
    def play(key, again):
        start = vector.reset(key)
        return start, rollout(hopping, vector.step, start, again, 4)[1]

    start, steps = play(jax.random.key(0), jax.random.key(1))
    assert start.obs.shape == (2, 5)
    assert len(np.unique(start.obs[:, 0])) == 2
    np.testing.assert_array_equal(steps.truncated[:, 0], [0, 0, 1, 0])
    assert not np.any(steps.terminated)
    assert np.all((steps.reward > 0.5) & (steps.reward <= 1))  # upright, in the middle


def test_robots_that_are_not_there_are_one_line():
    mjx_env = pytest.importorskip("mujoco_playground._src.mjx_env", reason="pip install playground")
    if mjx_env.MENAGERIE_PATH.exists():
        pytest.skip("MuJoCo Menagerie is there")
    assert "could not download" in complaint(name="Go1JoystickFlatTerrain")


@pytest.mark.study
def test_the_real_one_trains_and_is_evaluated(command, tmp_path):
    pytest.importorskip("mujoco_playground", reason="pip install playground")
    sizes = ("num_envs=8", "num_steps=4", "eval_episodes=2", "env.episode_length=8", "total_steps=64")
    run = tmp_path / "run"
    trained = command("train", "env=playground", "env.name=CartpoleBalance", *sizes, f"run_dir={run}", timeout=900)
    assert trained.returncode == 0, trained.stderr
    resumed = command("train", f"resume={run}", "total_steps=128", timeout=900)
    assert resumed.returncode == 0, resumed.stderr
    evaluated = command("evaluate", f"run={run}", "episodes=2", timeout=900)
    assert evaluated.returncode == 0, evaluated.stderr
    assert "reward/upright" in evaluated.stdout
