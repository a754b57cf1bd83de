"""The experiments run from beginning to end, here with tiny sizes; their figures come from the full ones."""

import ast
import copy
import json
import runpy
import subprocess
import sys
import types
from pathlib import Path

import gymnasium
import jax
import mujoco
import numpy as np
import onnx
import pytest
from onnx.reference import ReferenceEvaluator

from envs.base import State
from jaxpg.config.parsing import compose
from jaxpg.errors import UserError

EXPERIMENTS = Path(__file__).parent.parent / "experiments"
PEERS = EXPERIMENTS / "peers"
SCRIPTS = [script.stem for script in EXPERIMENTS.glob("*.py")]


PROGRAMS = [path for path in EXPERIMENTS.rglob("*.py") if '__name__ == "__main__"' in path.read_text(encoding="utf-8")]


def said(script, *arguments):
    """Exit status, standard output and standard error of a script."""
    command = [sys.executable, EXPERIMENTS / script, *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    return ended.returncode, ended.stdout, ended.stderr


def test_help_is_at_once():
    status, output, error = said("throughput.py", "--help")
    assert (status, error) == (0, "")
    assert "Steps per second of TD training on the pendulum, and where they go." in output


@pytest.fixture
def run(monkeypatch, capfd):
    """`run(script, *arguments)` as `said`, within this process, which has imported what is slow."""
    monkeypatch.syspath_prepend(str(PEERS))

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [str(script), *arguments])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(script), run_name="__main__")
        return end.value.code, *capfd.readouterr()

    return run


@pytest.mark.parametrize("script", PROGRAMS, ids=lambda path: path.stem)
def test_every_script_says_what_it_does_and_takes_nothing_unknown(script, run):
    doc = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8")))
    for flag in ("--help", "-h"):
        status, output, error = run(script, flag)
        assert (status, error) == (0, "")
        assert doc in output
    for wrong in ("--nonsense", "nonsense"):
        status, output, error = run(script, wrong)
        assert (status, output) == (2, "")
        assert error.startswith("error: ")
        assert "nonsense" in error
        assert len(error.splitlines()) == 1


MISTAKES = {
    "default_runs.py pendulm": "unknown task 'pendulm': did you mean 'pendulum'?; default_runs.py --help says more",
    "sweep.py --draws 0 env=arm": "argument --draws: 0: expected a whole number, at least 1; sweep.py --help says more",
    "sweep.py env=arm algo.gama=1": "unknown option 'algo.gama': did you mean 'algo.gamma'?",
    "endurance.py --seconds 0": "argument --seconds: 0: expected seconds, above 0; endurance.py --help says more",
    "endurance.py --seconds nan": "argument --seconds: nan: expected seconds, above 0; endurance.py --help says more",
    "endurance.py num_envz=3": "unknown option 'num_envz': did you mean 'num_envs'?",
    "peers/sb3.py algo=ppo": "out=... is missing; --help says more",
    "peers/sb3.py alg=ppo out=x": "unknown argument 'alg'; --help says more",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_mistakes_are_one_line(line, run):
    script, *arguments = line.split()
    assert run(EXPERIMENTS / script, *arguments) == (2, "", f"error: {MISTAKES[line]}\n")


@pytest.fixture
def experiments(monkeypatch, command_environment, tmp_path):
    """The scripts' common part, told to train for a moment only and to write elsewhere."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    for name, value in command_environment.items():
        monkeypatch.setenv(name, value)
    import commands

    full = commands.train

    def tiny(folder, *arguments):
        kept = [argument for argument in arguments if not argument.startswith("total_steps")]
        sizes = ["num_envs=2", "eval_episodes=4", "env.episode_length=10", "log_interval=20", "eval_interval=20"]
        sizes += ["report=false"]
        return full(folder, *kept, *sizes, "total_steps=40")

    monkeypatch.setattr(commands, "train", tiny)
    monkeypatch.setattr(commands, "RESULTS", tmp_path)
    yield tmp_path
    for name in SCRIPTS:
        sys.modules.pop(name, None)


@pytest.mark.study
def test_default_runs(experiments, monkeypatch):
    import default_runs

    monkeypatch.setattr(default_runs, "PENDULUM_RUNS", {"default": ((), 1)})
    monkeypatch.setattr(default_runs, "ARM_RUNS", default_runs.ARM_RUNS[-1:])
    monkeypatch.setattr(
        default_runs, "evaluate", lambda folder, *options: {"mean": -1.0, "stderr": 0.1, "success": 0.5}
    )
    default_runs.main([])
    rows = json.loads((experiments / "default_runs_arm.json").read_text())
    assert rows[0]["within_2cm"] == 0.5
    assert len(json.loads((experiments / "default_runs_pendulum.json").read_text())) == 1


def test_reinforce_and_td(experiments, monkeypatch):
    import reinforce_and_td

    monkeypatch.setattr(reinforce_and_td, "NUM_SEEDS", 2)
    monkeypatch.setattr(reinforce_and_td, "TASKS", {"quadratic": reinforce_and_td.TASKS["pendulum"]})
    reinforce_and_td.main()
    summary = json.loads((experiments / "reinforce_and_td.json").read_text())
    assert set(summary) == {"quadratic td", "quadratic reinforce"}
    assert all(curve["steps"] for curve in summary.values())
    assert (experiments / "reinforce_and_td.png").read_bytes().startswith(b"\x89PNG")


# Spheres, whose bound is exact, of a contact that is not light.
CLAW = """<mujoco><default><geom size=".02" pos=".3 0 0" condim="6"/></default><worldbody>
<body><joint name="a" axis="0 1 0"/><joint axis="0 0 1"/><geom/></body>
<body pos="0 0 {}"><joint axis="0 1 0"/><joint axis="0 0 1"/><geom/></body></worldbody>
<option gravity="0 0 0"/><actuator><motor joint="a" ctrlrange="-1 1"/></actuator></mujoco>"""


def share_that_touches(model, states, controls):
    """The share of 200 steps after which C MuJoCo finds a contact; bounds of spheres are exact."""
    counts = []
    for qvel, ctrl in zip(states["qvel"], controls, strict=True):
        data = mujoco.MjData(model)
        data.qvel, data.ctrl = qvel, ctrl
        for _ in range(200):
            mujoco.mj_step(model, data)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            counts.append(data.ncon > 0)
    return np.mean(counts)


def test_robots(experiments, monkeypatch):
    import robots

    monkeypatch.setattr(robots, "SECONDS", 0.01)
    texts = {"near": CLAW.format(0.045), "far": CLAW.format(1), "none": "<mujoco/>", "broken": "<mujoco>"}
    for name, text in texts.items():
        (experiments / f"{name}.xml").write_text(text)
    robots.main([f"robots={experiments}", "--envs", "4", "--steps", "200", "--rounds", "1"])
    rows = {row["model"].split("/")[1]: row for row in json.loads((experiments / "robots.json").read_text())}
    assert rows["none"]["error"]
    assert rows["broken"]["error"]
    assert (rows["near"]["watched"], rows["far"]["watched"]) == (1, 0)
    model = mujoco.MjModel.from_xml_string(texts["near"])
    for kind, share in robots.CONTROLS.items():
        touching = share_that_touches(model, robots.make_states(model, 4), robots.make_controls(model, 4, share))
        assert 0.05 < touching < 0.95
        assert abs(rows["near"]["speeds"][kind]["left_to_c"] - touching) < 0.01
    low, middle, high = rows["far"]["speeds"]["all"]["ours_over_C"]
    assert 0 < low <= middle <= high


def test_long_run(experiments, monkeypatch):
    """Ours is C MuJoCo's, and what a wrong model does is seen: here one with another damping."""
    import long_run

    (experiments / "claw.xml").write_text(CLAW.format(1))
    monkeypatch.setattr(long_run, "SYSTEMS", {"pendulum": long_run.SYSTEMS["double pendulum, Euler"]})
    long_run.main([str(experiments / "claw.xml"), "--envs", "3", "--steps", "20", "--long_steps", "200"])
    found = json.loads((experiments / "long_run.json").read_text())
    assert found["models"][0]["ours"]["velocity"][1] < 1e-12
    methods = found["systems"][0]["methods"]
    np.testing.assert_allclose(methods["float64"]["energy"], methods["C"]["energy"], rtol=1e-9)
    np.testing.assert_allclose(methods["float32"]["energy"], methods["C"]["energy"], rtol=1e-3)
    play_in_c = long_run.play_in_c

    def damp(model, *given):
        model = copy.copy(model)
        model.dof_damping[:] = 0.01
        return play_in_c(model, *given)

    monkeypatch.setattr(long_run, "play_in_c", damp)
    long_run.main([str(experiments / "claw.xml"), "--envs", "3", "--steps", "20", "--long_steps", "100"])
    found = json.loads((experiments / "long_run.json").read_text())
    assert found["models"][0]["ours"]["velocity"][1] > 1e-6


def test_systems_of_long_runs_are_names_or_model_files(experiments):
    import long_run

    path = experiments / "claw.xml"
    path.write_text(CLAW.format(1))
    name = f"{experiments.name}/claw"
    assert long_run.find_systems(["ant", str(path)]) == {"ant": long_run.SYSTEMS["ant"], name: path}
    with pytest.raises(UserError, match=r"atn: expected a model file or one of .*; ant$"):
        long_run.find_systems(["atn"])


@pytest.mark.study
def test_throughput(experiments, monkeypatch):
    import throughput

    sizes = {"NUM_ENVS": (16,), "WIDTHS": (32,), "SAMPLES": 2048, "ROUNDS": 1}
    sizes |= {"ALGORITHMS": ("td",), "SEEDS": (2,), "IN_ONE_PROGRAM": (1, 2)}
    for name, value in {"TASK": "quadratic", **sizes}.items():
        monkeypatch.setattr(throughput, name, value)
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        throughput.main()
    result = json.loads((experiments / "throughput.json").read_text())
    assert throughput.operations(3, 4) == 7.25 * 2 * (3 * 4 + 4 * 4 + 4)
    (row,) = result["sizes"]
    of_peak = throughput.operations(1, 32) * row["training, steps/s"] / (1e9 * row["peak, GFLOP/s"])
    assert 0 < row["share of peak"] == pytest.approx(of_peak, abs=2e-3)
    assert row["products alone"] > row["share of peak"]
    (row,) = result["agents"]
    assert all(0 < row[f"{size} in a program"] < 10 for size in (1, 2))


@pytest.mark.study
def test_robustness(experiments, monkeypatch):
    import robustness

    monkeypatch.setattr(robustness, "TASKS", {"quadratic": ("env=quadratic", "log_interval=1000")})
    monkeypatch.setattr(robustness, "train", lambda *_: None)  # nothing is compiled beforehand
    monkeypatch.setattr(robustness, "STOPS", 2)
    monkeypatch.setattr(robustness, "STEPS", 100_000)
    robustness.main()
    (row,) = json.loads((experiments / "robustness.json").read_text())
    assert 0 < row["median, s"] <= row["worst, s"] < 60
    assert 0 < row["share"] < 1


@pytest.mark.study
def test_endurance(experiments, monkeypatch):
    import endurance

    monkeypatch.setattr(endurance, "TASK", "quadratic")
    endurance.main(["--seconds", "2"])
    result = json.loads((experiments / "endurance.json").read_text())
    assert min(result["resident, MB"]) > 100
    assert result["steps"] > 0
    assert (experiments / "endurance.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.study
def test_deploy(experiments, monkeypatch):
    import deploy

    for name, value in {"TASK": "quadratic", "CALLS": 10, "LOOPS": 1000}.items():
        monkeypatch.setattr(deploy, name, value)
    deploy.main()
    result = json.loads((experiments / "deploy.json").read_text())
    assert max(result["differences"].values()) < 1e-5
    assert all(value > 0 for value in result["ns"].values())
    assert result["c"]["variables, bytes"] == 0 < result["c"]["code and constants, bytes"]
    np.testing.assert_allclose(list(result["returns"].values()), result["returns"]["jax, mjx"], atol=1e-3)


def test_sigma_choices(experiments, monkeypatch):
    import sigma_choices

    monkeypatch.setattr(sigma_choices, "TASK", "quadratic")
    monkeypatch.setattr(sigma_choices, "NUM_SEEDS", 2)
    monkeypatch.setattr(sigma_choices, "CHOICES", {"state": sigma_choices.CHOICES["of the state, from 1"]})
    sigma_choices.main()
    summary = json.loads((experiments / "sigma_choices.json").read_text())
    assert summary["state"]["return"]["seeds"] == 2
    assert summary["state"]["sigma"]["interquartile_mean"]
    assert (experiments / "sigma_choices.png").read_bytes().startswith(b"\x89PNG")


def test_sweep(experiments, monkeypatch, capsys):
    """A draw is the training that has its values as options."""
    import sweep

    monkeypatch.setattr(sweep, "prepare", lambda config: None)  # it is too late in this process
    sizes = ["env=quadratic", "algo=td", "num_envs=4", "total_steps=640", "eval_episodes=8"]
    sweep.main(["--draws", "3", "--seeds", "2", *sizes])
    assert "3 draws, 2 seeds of each" in capsys.readouterr().out
    returns = [row["return"] for row in json.loads((experiments / "sweep_quadratic_td.json").read_text())["draws"]]
    assert returns == sorted(returns, reverse=True)
    assert len(set(returns)) == 3
    drawn = sweep.results(compose(sizes), [{"algo.actor_lr": 0.01}, {"algo.actor_lr": 0.1}], 2)["return"]
    given = sweep.results(compose([*sizes, "algo.actor_lr=0.1"]), [{}], 2)["return"]
    np.testing.assert_allclose(drawn[1], given[0], rtol=1e-4)
    assert abs(drawn[0] - drawn[1]) > 1e-3 * abs(drawn[1])


def test_lesson_toy(experiments, monkeypatch):
    import lesson_toy

    monkeypatch.setattr(lesson_toy, "NUM_UPDATES", 5)
    monkeypatch.setattr(lesson_toy, "LESSON_SEEDS", 2)
    monkeypatch.setattr(lesson_toy, "DEFAULT_SEEDS", 2)
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        lesson_toy.main()
    summary = json.loads((experiments / "lesson_toy.json").read_text())
    assert summary["the lesson's update"]["after 5 updates"]["median cost over best"] > 1
    assert (experiments / "lesson_toy.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.study
def test_online_pendulum(experiments, monkeypatch):
    import online_pendulum

    monkeypatch.setattr(online_pendulum, "NUM_SEEDS", 2)
    monkeypatch.setattr(online_pendulum, "FACTORS", (1.0,))
    monkeypatch.setattr(online_pendulum, "NETWORKS", {"linear": ()})
    monkeypatch.setattr(online_pendulum, "SIZES", ("num_envs=2", "total_steps=800", "env.episode_length=10"))
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        online_pendulum.main()
    summary = json.loads((experiments / "online_pendulum.json").read_text())
    assert len(summary["curves"]["linear"]["steps"]) > 1
    assert (experiments / "online_pendulum.png").read_bytes().startswith(b"\x89PNG")


def test_startup(experiments, monkeypatch):
    import startup

    sizes = ("num_envs=2", "num_steps=4", "eval_episodes=2", "env.episode_length=8", "total_steps=16", "report=false")
    monkeypatch.setattr(startup, "ARGUMENTS", ("env=quadratic", "network=linear", *sizes))
    startup.main()
    runs = json.loads((experiments / "startup.json").read_text())
    assert set(runs) == {"train, cold", "train, warm", "evaluate, cold", "evaluate, warm"}
    for name in ("train, cold", "train, warm"):
        assert 0 < runs[name]["of it tracing"]["seconds"] < runs[name]["tracing and compiling"]["seconds"]
        assert runs[name]["tracing and compiling"]["seconds"] < runs[name]["whole process"]["seconds"]


def test_estimator_table(experiments, monkeypatch, capsys):
    import estimator_table

    monkeypatch.setattr(estimator_table, "NUM_BATCHES", 1)
    estimator_table.main()
    table = json.loads((experiments / "estimator_table.json").read_text())
    assert capsys.readouterr().out.count("\n") == len(table) + 2
    assert max(row["errors"] for sizes in table.values() for row in sizes.values()) < 4
    assert table["td_zero, wrong critic"]["n = 3"]["bias"] > 0.5


def test_gradient_variance(experiments, monkeypatch):
    import gradient_variance

    monkeypatch.setattr(gradient_variance, "NUM_EPISODES", 4096)
    monkeypatch.setattr(gradient_variance, "BATCH_SIZES", (2, 64))
    monkeypatch.setattr(gradient_variance, "LAMBDAS", np.array([0.0, 1.0]))
    gradient_variance.main()
    summary = json.loads((experiments / "gradient_variance.json").read_text())
    assert summary["squared error x episodes"]["none"][1] > 3 * summary["squared error x episodes"]["value"][1]
    assert summary["squared bias"][1] == 0
    assert (experiments / "gradient_variance.png").read_bytes().startswith(b"\x89PNG")


STUB = f"""
import sys
sys.path.insert(0, {str(PEERS)!r})
from protocol import begin
options, recorder = begin()
recorder.ready()
for steps, torque in ((100, 0.0), (200, float(options["torque"]))):
    recorder.look(steps, lambda obs: torque - obs[:, 2])
"""


def test_time_to_solve(experiments, monkeypatch, tmp_path, capsys):
    import time_to_solve

    stub = tmp_path / "stub.py"
    stub.write_text(STUB, encoding="utf-8")
    contestants = [
        time_to_solve.Contestant("stub", str(stub), 30, options=("torque=0.1",)),
        time_to_solve.Contestant("broken", str(stub), 30),
        time_to_solve.Contestant("absent", str(stub), 30, venv="sb3"),
    ]
    monkeypatch.setattr(time_to_solve, "CONTESTANTS", contestants)
    monkeypatch.setattr(time_to_solve, "TARGETS", (-2000, 0))
    monkeypatch.setattr(time_to_solve, "JAXPG", {"TD": ()})
    monkeypatch.setattr(time_to_solve, "evaluate", lambda folder, *options: {"mean": -1.0, "stderr": 0.1})
    time_to_solve.main(["--seeds", "2", "--venvs", str(tmp_path / "none")])
    printed = capsys.readouterr().out
    assert "absent is left out; to install it:" in printed
    assert "broken, seed 1: failed, KeyError: 'torque'" in printed
    assert "100 steps | not within " in printed
    rows = json.loads((experiments / "time_to_solve.json").read_text())["contestants"]
    assert rows["stub"]["curves"][1]["steps"] == [100, 200]
    assert (experiments / "time_to_solve.png").read_bytes().startswith(b"\x89PNG")


def test_jaxpg_is_a_contestant(tmp_path):
    """Its curve ends with the last update."""
    out = tmp_path / "curve.json"
    options = ["algo=td", "total_steps=2000", "log_interval=512", f"out={out}"]
    subprocess.run([sys.executable, PEERS / "own.py", *options], check=True)
    (point,) = json.loads(out.read_text())
    assert point["steps"] == 2048
    assert point["seconds_training"] < point["seconds_since_process_start"]


def test_the_evaluation_is_gymnasiums(monkeypatch):
    """All 200 starts, under a controller in float32 that swings up and balances."""
    monkeypatch.syspath_prepend(str(PEERS))
    import protocol

    def act(obs):
        cos, sin, speed = obs.T
        energy = speed**2 / 6 + 5 * (cos - 1)
        return np.where(cos > 0.9, -8 * sin - 2 * speed, -np.sign(speed) * energy)

    pendulums = gymnasium.make_vec("Pendulum-v1", num_envs=protocol.NUM_STARTS, vectorization_mode="sync")
    obs, _ = pendulums.reset(seed=list(range(protocol.NUM_STARTS)))
    np.testing.assert_array_equal(obs, protocol.observe(protocol.starts()))
    returns = np.zeros(protocol.NUM_STARTS)
    for _ in range(protocol.EPISODE_LENGTH):
        obs, reward, _, truncated, _ = pendulums.step(act(obs)[:, None])
        returns += reward
    assert truncated.all()
    np.testing.assert_allclose(protocol.play(act), returns, rtol=1e-6)
    assert returns.mean() > -400


SMALL = ("num_envs=4", "num_steps=4", "total_steps=32", "algo.num_shards=1", "algo.minibatches=1", "eval_episodes=2")


@pytest.fixture
def reach(monkeypatch):
    import reach

    monkeypatch.setattr(reach, "prepare", lambda config: None)  # it is too late in this process
    monkeypatch.setattr(reach, "divide_cpu", lambda: None)
    monkeypatch.setattr(reach, "GOALS", 4)
    return reach


def test_reached_is_what_was_held_to_the_end(reach, monkeypatch):
    """Of four goals one is left again, and one is held within 2 cm but not within 1 cm; angles count with pose only."""

    class Training(reach.Training):
        def __init__(self):
            env = types.SimpleNamespace(hold_time=0.04, dt=0.02, success_angle=0.1)
            self.config = types.SimpleNamespace(env=env)
            self.state = types.SimpleNamespace()

    distance = np.array(
        [[0.5, 0.3, 0.004, 0.003], [0.5, 0.3, 0.019, 0.004], [0.5, 0.004, 0.2, 0.004], [0.1, 0.1, 0.1, 0.1]]
    )
    angle = np.array([[0.0] * 4, [0.0] * 4, [0.0] * 4, [0.0] * 4])
    metrics = {"distance": distance[:, -1], "jerk": np.ones(4), "limit_violation": np.zeros(4)}
    monkeypatch.setattr(reach, "get_policy", lambda state: ())
    found = Training().try_policy(lambda policy: (metrics, (distance, angle)))
    assert found["shares"] == [0.5, 0.5, 0.25]
    angle[0, -1] = 0.2
    assert Training().try_policy(lambda policy: (metrics, (distance, angle)))["shares"] == [0.25, 0.25, 0.0]


@pytest.mark.study
def test_reach(reach, experiments):
    options = [argument for option in SMALL for argument in ("--option", option)]
    reach.main(["so100", "--seeds", "1", *options])
    (found,) = json.loads((experiments / "reach.json").read_text())
    (row,) = found["seeds"]
    assert row["steps"] >= 32
    assert all(0 <= share <= 1 for who in ("end", "mujoco") for share in row[who]["shares"])


@pytest.mark.study
def test_mujoco_environments(experiments, capsys):
    import mujoco_environments

    sizes = ("--envs", "4", "--steps", "5", "--rounds", "1")
    mujoco_environments.main(["brax:inverted_pendulum", "brax:swimmer", *sizes])
    found, refused = json.loads((experiments / "mujoco_environments.json").read_text())
    assert found["scalar"]["reward"] == found["mujoco"]["reward"] == found["mjx"]["reward"] == 1
    assert found["mjx"]["ratio"][1] == pytest.approx(found["scalar"]["rate"][1] / found["mjx"]["rate"][1])
    assert "swimmer" in refused["error"]
    assert len(capsys.readouterr().out.splitlines()) == 3


@pytest.mark.study
def test_rewards_of_mujoco_environments_are_those_of_the_same_states_and_actions(experiments):
    import mujoco_environments

    # enough environments that only the equations are divided over devices, where there are several
    sizes = ("--envs", str(16 * mujoco_environments.count_parts(2**20)), "--steps", "5", "--rounds", "1")
    mujoco_environments.main(["brax:inverted_double_pendulum", *sizes, "--without", "mjx"])
    (found,) = json.loads((experiments / "mujoco_environments.json").read_text())
    assert found["scalar"]["difference"][1] < 1e-4
    assert found["scalar"]["reward"] == pytest.approx(found["mujoco"]["reward"], abs=1e-5)


def test_a_mean_reward_ends_with_the_first_episode():
    import mujoco_environments

    rewards = np.array([[1.0, 2.0, 9.0], [1.0, 2.0, 3.0]])
    parts = [(rewards[:, :1], np.zeros((2, 1))), (rewards[:, 1:], np.array([[1, 0], [0, 0]]))]
    np.testing.assert_array_equal(mujoco_environments.average_rewards(parts), [1.5, 2.0])


def save_network(path, *nodes, axis=-1):
    """An ONNX file of a network from three observations to two commands, by the given operators after a layer."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    random = np.random.default_rng(0)
    constants = {"mean": random.normal(size=3), "weight": random.normal(size=(3, 4)), "bias": random.normal(size=4)}
    layer = ("Sub", ["obs", "mean"], ["centred"]), ("Gemm", ["centred", "weight", "bias"], ["x"])
    graph = helper.make_graph(
        [helper.make_node(*node, **{"axis": axis} if node[0] == "Split" else {}) for node in (*layer, *nodes)],
        "policy",
        [helper.make_tensor_value_info("obs", kind, [None, 3])],
        [helper.make_tensor_value_info("action", kind, [None, 2])],
        [onnx.numpy_helper.from_array(x.astype(np.float32), name) for name, x in constants.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 11)]), path)
    return path


def test_a_published_policy_acts_as_its_file_says(experiments):
    import published_policies

    tail = (
        ("Sigmoid", ["x"], ["s"]),
        ("Mul", ["x", "s"], ["y"]),
        ("Split", ["y"], ["z", "w"]),
        ("Tanh", ["z"], ["action"]),
    )
    path = save_network(experiments / "policy.onnx", *tail)
    obs = np.random.default_rng(1).normal(size=(5, 3)).astype(np.float32)
    (expected,) = ReferenceEvaluator(str(path)).run(None, {"obs": obs})
    np.testing.assert_allclose(published_policies.read_policy(path)(obs), expected, atol=1e-6)
    other = save_network(experiments / "other.onnx", ("Relu", ["x"], ["y"]), ("Split", ["y"], ["action", "w"]))
    with pytest.raises(UserError, match="its operators Relu are not among Sub, Mul"):
        published_policies.read_policy(other)
    rows = save_network(experiments / "rows.onnx", ("Split", ["x"], ["action", "w"]), axis=0)
    with pytest.raises(UserError, match="its operators Split are not among"):
        published_policies.read_policy(rows)
    (experiments / "text.onnx").write_text("weights")
    with pytest.raises(UserError, match="cannot be read as an ONNX model"):
        published_policies.read_policy(experiments / "text.onnx")


def test_a_return_ends_with_the_first_episode(experiments):
    import published_policies

    class Counting:
        """Earns the action, and ends after two steps where the key says so."""

        def reset(self, key):
            flag = jax.random.bernoulli(key).astype(float)
            return State(None, np.zeros(1), flag * 0, flag * 0, {"flag": flag, "time": flag * 0})

        def step(self, state, action):
            now = state.metrics["time"] + 1
            done = state.metrics["flag"] * (now == 2)
            return state.replace(reward=action, done=done, metrics={**state.metrics, "time": now})

    returns, ended = published_policies.play(Counting(), lambda obs: obs[:, 0] + 1.5, 8, 5)
    assert 0 < ended.sum() < 8
    np.testing.assert_array_equal(returns, np.where(ended, 3.0, 7.5))
