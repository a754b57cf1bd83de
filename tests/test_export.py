"""A policy leaves the library as C, ONNX or StableHLO, and commands what JAX commands."""

import json
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stored import a_policy

from jaxpg import evaluate
from jaxpg import export as command_line
from jaxpg.config.parsing import compose
from jaxpg.config.schema import ACTIVATIONS, FEATURES
from jaxpg.deploy import c, header, learner_replay, onnx, reference, stablehlo
from jaxpg.deploy.controller import collect_observations, make_command, make_controller
from jaxpg.deploy.exporter import FORMATS, TOLERANCE, make_trial
from jaxpg.errors import UserError
from jaxpg.program.networks import make_networks
from jaxpg.types import Transition

RELU = ("network.activation=relu",)
POLICIES = {
    "two commands": ("env=arm", "network.widths=[16,8]", "network.activation=tanh"),
    "velocities": ("env=arm", "env.control=velocity", "network.widths=[8]", "network.activation=elu"),
    "products": ("env=pendulum", "network.features=polynomial", "network.order=3", "network.widths=[8]", *RELU),
    "not squashed": ("env=pendulum", "network.squash=false", "network.activation=swish"),
    "linear": ("env=pendulum", "network=linear", "network.features=polynomial", "network.order=1"),
    "frequencies": ("env=pendulum", "network=linear", "network.features=fourier", "network.order=3"),
    "bumps": ("env=pendulum", "network=linear", "network.features=radial", "network.order=4"),
    "bumps of layers": ("env=pendulum", "network.features=radial", "network.order=2", "network.widths=[4]"),
    "sigma of the state": ("env=pendulum", "network.sigma_is=state", "network.widths=[8]"),
    "no limits": ("env=quadratic", "network=linear", "network.squash=false", "env.state_size=3"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """`written(name) -> (controller, folder, command, obs)` of one of `POLICIES`, in every format."""
    made = {}

    def make(name):
        if name not in made:
            stored, folder = a_policy(*POLICIES[name]), tmp_path_factory.mktemp("export")
            control, command = make_controller(stored, {"policy": "drawn by a test"}), make_command(stored)
            for way in FORMATS.values():
                way.write(control, folder, command)
            made[name] = control, folder, command, collect_observations(stored)
        return made[name]

    return make


def test_every_kind_of_policy_is_tried():
    configs = [compose(options) for options in POLICIES.values()]
    assert {config.network.features for config in configs} == set(FEATURES)
    assert {getattr(config.network, "activation", "tanh") for config in configs} == set(ACTIVATIONS)


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("form", ["jax", *FORMATS])
def test_commands_are_the_formulas(name, form, written):
    """In units of the limit, against float64; JAX's too."""
    control, folder, command, obs = written(name)
    assert obs.shape == (10_000, control.observation_size)
    tried = make_trial(control, obs)
    assert tried.exact.std() > 0.01  # they differ, and are not all at a limit
    found = np.asarray(jax.jit(command)(obs)) if form == "jax" else FORMATS[form].load(control, folder)(obs)
    assert found.shape == (10_000, control.action_size)
    assert tried.error(found) <= TOLERANCE  # none of them is steep


@pytest.mark.parametrize("name", POLICIES)
def test_c_with_double_is_the_formula_in_double(name, written):
    """To 1e-12, where float has 1e-7: by numpy's own arithmetic."""
    control, folder, _, obs = written(name)
    found = c.load(control, folder, double=True)(obs[::10])
    np.testing.assert_allclose(found, reference.compute_commands(control, obs[::10]), rtol=0, atol=1e-12)


def test_the_header_says_what_it_is(written):
    control, folder, *_ = written("velocities")
    text = (folder / "arm.h").read_text()
    assert "command[1]: elbow velocity [rad/s], at most 4 either way" in text
    assert "observation[5]: q_elbow' [rad/s]" in text
    assert "policy: drawn by a test" in text
    assert control.interface.limits == (4.0, 4.0)


def test_onnx_takes_any_batch_and_says_what_it_is(written):
    import onnxruntime

    _, folder, command, obs = written("two commands")
    session = onnxruntime.InferenceSession(str(folder / "arm.onnx"), providers=["CPUExecutionProvider"])
    for number in (1, 7):
        (found,) = session.run(None, {"observation": obs[:number]})
        np.testing.assert_allclose(found, command(obs[:number]), atol=1e-5)
    about = session.get_modelmeta().custom_metadata_map
    assert about["commands"] == "shoulder torque [N m]; elbow torque [N m]"
    assert about["limits"] == "(2.0, 2.0)"


LOADED_ELSEWHERE = """
import json, sys
import jax, jax.export, numpy as np
program = jax.export.deserialize(bytearray(open(sys.argv[1], "rb").read()))
obs = np.array(json.loads(sys.argv[2]), np.float32)
print(json.dumps(np.asarray(program.call(obs)).tolist()))
assert not [name for name in sys.modules if name.startswith(("jaxpg", "envs", "flax", "mujoco"))]
"""


def test_stablehlo_is_read_without_this_library(written, tmp_path):
    _, folder, command, obs = written("products")
    arguments = [str(folder / "pendulum.stablehlo"), json.dumps(obs[:1].tolist())]
    result = subprocess.run([sys.executable, "-c", LOADED_ELSEWHERE, *arguments], capture_output=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    np.testing.assert_allclose(json.loads(result.stdout), command(obs[:1]), atol=1e-6)


# --- going on with learning -------------------------------------------------------------------------------------------

ONLINE = ("algo=online", "network=linear", "algo.actor_lr=1e-5", "algo.critic_lr=1e-4")
LEARNERS = {
    "sigma learned": ("env=pendulum", *ONLINE, "network.features=polynomial", "network.order=2"),
    "discounted": ("env=pendulum", *ONLINE, "network.sigma_is=fixed", "algo.discounted=true", "algo.lambda_actor=0.5"),
    "two commands": ("env=arm", *ONLINE, "network.squash=true", "algo.reward_scale=0.5", "network.features=identity"),
}


def some_steps(stored, number=1000):
    """Drawn, with ends of both kinds."""
    keys = iter(jax.random.split(jax.random.key(5), 9))
    n, m = stored.env.observation_size, stored.env.action_size
    obs = jax.random.normal(next(keys), (2, number, 1, n))
    ends = jax.random.uniform(next(keys), (2, number, 1)) < jnp.array([0.02, 0.05])[:, None, None]
    zeros = jnp.zeros((number, 1))
    return Transition(
        obs=obs[0],
        u=jax.random.normal(next(keys), (number, 1, m)),
        reward=-jax.random.uniform(next(keys), (number, 1)),
        terminated=ends[0].astype(jnp.float32),
        truncated=(ends[1] & ~ends[0]).astype(jnp.float32),
        next_obs=obs[1],
        episode_end=zeros,
        episode_return=zeros,
        diverged=zeros,
    )


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("name", LEARNERS)
def test_a_thousand_updates_in_c_are_those_of_jax(name, double, tmp_path):
    """Every parameter after every update: to 1e-4 in float, to 1e-9 in double."""
    stored = a_policy(*LEARNERS[name])
    control, transition = make_controller(stored, {}), some_steps(stored)
    c.write(control, tmp_path)
    networks = make_networks(stored.config, stored.env)
    found = c.compile_example(control, tmp_path / "learn.c", double)(learner_replay.to_rows(transition))
    with jax.enable_x64(double):
        kind = np.float64 if double else np.float32
        policy, steps = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, kind)), (stored.policy, transition))
        scale = np.asarray(control.scale, kind)  # what is written is rounded to float
        policy = policy._replace(normalizer=policy.normalizer._replace(variance=jnp.asarray(scale**-2)))
        expected = learner_replay.learn(
            networks, stored.config.algo, policy, control.learner.log_std.astype(kind), steps
        )
        assert expected.dtype == kind
        expected = np.asarray(expected)
    assert found.shape == expected.shape
    assert np.abs(expected[-1] - expected[0]).max() > 1e-3  # it has learned
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 if double else 1e-4)
    header = (tmp_path / f"{control.name}.h").read_text()
    assert ("z->log_sigma[j] = keep_actor" in header) == (stored.config.network.sigma_is == "learned")


SAMPLE = """
#include <stdio.h>
#include "arm.h"
int main(void) {
    arm_learner learner;
    float s[ARM_OBSERVATIONS], u[2], command[2], none[2] = {0, 0}, one[2] = {1, 1};
    arm_begin(&learner);
    for (;;) {
        for (int i = 0; i < ARM_OBSERVATIONS; i++)
            if (scanf("%f", &s[i]) != 1) return 0;
        arm_sample(&learner, s, none, u, command);
        printf("%.9g %.9g %.9g %.9g ", (double)u[0], (double)u[1], (double)command[0], (double)command[1]);
        arm_sample(&learner, s, one, u, command);
        printf("%.9g %.9g\\n", (double)u[0], (double)u[1]);
    }
}
"""


def test_a_sample_of_the_learner_is_the_policys(tmp_path):
    """With noise 0 the command is that of the controller; with noise 1 u is a sigma further."""
    stored = a_policy(*LEARNERS["two commands"])
    control = make_controller(stored, {})
    c.write(control, tmp_path)
    (tmp_path / "sample.c").write_text(SAMPLE)
    obs = collect_observations(stored)[:50]
    drawn = c.compile_example(control, tmp_path / "sample.c")(obs)
    np.testing.assert_allclose(drawn[:, 2:4], c.load(control, tmp_path)(obs), atol=1e-6)
    np.testing.assert_allclose(
        drawn[:, 4:6] - drawn[:, :2], np.exp(control.learner.log_std)[None] + np.zeros((50, 1)), atol=1e-5
    )


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    sizes = ("num_envs=2", "num_steps=4", "total_steps=16", "log_interval=8", "eval_interval=8", "eval_episodes=2")
    env = ("env=quadratic", "env.episode_length=8", "num_seeds=2")
    result = command("train", *env, *sizes, "report=false", f"run_dir={folder}")
    assert result.returncode == 0, result.stderr
    return folder


def test_all_formats_of_a_run(run, command):
    result = command("export", f"run={run}", "format=all", "agent=1")
    assert result.returncode == 0, result.stderr
    first, tried, *lines = result.stdout.splitlines()
    assert first.startswith(
        "td on quadratic, seed 1, best policy (saved after 2 updates), 1 observations to 1 commands"
    )
    assert re.fullmatch(
        r"tested +on 10,000 observations, \d,\d{3} from episodes and the others random; "
        r"errors relative to the largest command, against float64",
        tried,
    )
    assert [line.split()[0] for line in lines] == ["jax", *FORMATS]
    assert all(re.match(r"\w+ +error \d\.\de[-+]\d\d at most(: |$)", line) for line in lines)
    names = {"quadratic.h", "main.c", "Makefile", "quadratic.onnx", "quadratic.stablehlo", "quadratic.mlir"}
    assert {path.name for path in (run / "export").iterdir()} == names
    subprocess.run(["make", "-C", str(run / "export")], check=True, capture_output=True)


def test_what_was_written_plays_as_the_policy_does(run, capsys):
    means = {}
    for policy in ("jax", *FORMATS):
        assert evaluate.main([f"run={run}", f"policy={policy}", "episodes=20", "json=true"]) == 0
        means[policy] = json.loads(capsys.readouterr().out.splitlines()[-1])["mean"]
    np.testing.assert_allclose(list(means.values()), means["jax"], atol=1e-3)
    with pytest.raises(UserError, match="backend=mujoco: env=quadratic is not stepped by MuJoCo; backend=mjx plays it"):
        evaluate.main([f"run={run}", "backend=mujoco"])


WRONG = {
    "another activation": (header.ACTIVATIONS, "tanh", "y[i] / (1 + POLICY_F(fabs)(y[i]))"),
    "features off by one": (header.FEATURES, "identity", "    for (int i = 0; i < {size}; i++) x[i] = z[0];\n"),
}


@pytest.mark.parametrize("bug", WRONG)
def test_what_commands_something_else_is_not_written(bug, monkeypatch, tmp_path):
    table, name, wrong = WRONG[bug]
    monkeypatch.setitem(table, name, wrong)
    stored = a_policy(*POLICIES["two commands"])
    monkeypatch.setattr("jaxpg.store.policies.load", lambda *_: stored)
    monkeypatch.setattr("jaxpg.deploy.exporter.describe_origin", lambda *_: {"policy": "drawn"})
    with pytest.raises(UserError, match=r"format=c: the commands differ from the formula's by .*; nothing is written"):
        command_line.main(["run=somewhere", f"out={tmp_path / 'out'}"])
    assert not (tmp_path / "out").exists()


def test_mistakes_are_one_line(run, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("mine")
    mistakes = {
        (): "run=DIR is missing",
        ("run=nowhere",): "nowhere is not a run folder",
        (f"run={run}", "format=onx"): "format=onx: must be c or onnx or stablehlo or all",
        (f"run={run}", f"out={tmp_path / 'file'}"): "a file has that name",
        (f"run={run}", "agent=2"): "agent=2: the run has agents 0 to 1",
    }
    for arguments, message in mistakes.items():
        with pytest.raises(Exception, match=message):
            command_line.main(arguments)
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(UserError, match="there is no no-such-compiler: install gcc, or set CC"):
        command_line.main([f"run={run}", f"out={tmp_path / 'out'}"])
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(UserError, match="pip install onnx onnxruntime"):
        command_line.main([f"run={run}", "format=onnx", f"out={tmp_path / 'out'}"])
    assert not (tmp_path / "out").exists()


def test_stablehlo_runs_on_other_platforms_too(written):
    control, folder, *_ = written("linear")
    exported = jax.export.deserialize(bytearray((folder / f"{control.name}.stablehlo").read_bytes()))
    assert set(exported.platforms) == set(stablehlo.PLATFORMS)
    assert onnx.OPSET >= 18
