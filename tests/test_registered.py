"""What a registry entry says to a training: mistakes are found, what it leaves out is filled in, no state is left."""

import dataclasses
import subprocess
import sys
import threading
from typing import Literal

import pytest
from environments import SIZES, Config, register
from processes import outcome, tree

import envs
from envs.options import OptionError, option
from jaxpg import train
from jaxpg.commands.ending import run_command
from jaxpg.config import configuration
from jaxpg.config.parsing import compose
from jaxpg.store import cache_folder, config_file

RUN = tuple(size for size in SIZES if not size.startswith("network"))


def problems_of(monkeypatch, arguments=(), **entry):
    register(monkeypatch, "odd", **entry)
    with pytest.raises(OptionError) as caught:
        compose(["env=odd", *arguments])
    return caught.value.problems


TYPOS = {
    "misspelt": ({"td": {"num_stepz": 8}}, "td: unknown option 'num_stepz': did you mean 'num_steps'?"),
    "misspelt in a group": ({"td": {"algo.gama": 0.5}}, "td: unknown option 'algo.gama': did you mean 'algo.gamma'?"),
    "without its group": ({"td": {"gamma": 0.5}}, "td: unknown option 'gamma': did you mean 'algo.gamma'?"),
    "of an algorithm that is not chosen": (
        {"td": {}, "ppo": {"algo.clap": 0.1}},
        "ppo: unknown option 'algo.clap': did you mean 'algo.clip'?",
    ),
    "misspelt option of its own": ({"td": {"env.sped": 1}}, "td: unknown option 'env.sped': did you mean 'env.speed'?"),
    "misspelt algorithm": ({"poo": {"num_envs": 8}}, "unknown algo 'poo': did you mean 'ppo'?"),
    "misspelt network": ({"td": {"network": "linar"}}, "td: unknown network 'linar': did you mean 'linear'?"),
    "wrong type": ({"td": {"num_envs": "many"}}, "td: num_envs=many: expected a whole number"),
    "out of range": ({"td": {"algo.gamma": 1.5}}, "td: algo.gamma=1.5: must be at least 0, at most 1"),
    "unknown choice": ({"td": {"network.activation": "gelu"}}, "td: network.activation=gelu: must be tanh or relu or"),
    "shards in words": ({"ppo": {"num_envs": 8, "algo.num_shards": "two"}}, "ppo: algo.num_shards=two: expected a"),
    "without their algorithm": ({"num_envs": 64}, "unknown algo 'num_envs': known are online, ppo, reinforce, td"),
    "a list of algorithms": (["td"], "expected values by algorithm, such as {'td': {'num_envs': 64}}, not ['td']"),
    "a number for the values": ({"td": 64}, "td: expected values by option, such as {'num_envs': 64}, not 64"),
    "a number for a name": ({"td": {3: 64}}, "td: unknown option '3'"),
}


@pytest.mark.parametrize("typo", TYPOS)
def test_mistakes_in_training_values_are_lines_that_name_the_entry(typo, monkeypatch):
    training, message = TYPOS[typo]
    (problem,) = problems_of(monkeypatch, training=training)
    assert problem.startswith(f"env=odd, training values: {message}")


def test_all_mistakes_are_said_at_once(monkeypatch):
    training = {"td": {"num_stepz": 8, "algo.gama": 0.5}, "ppo": {"num_envs": 0}}
    assert len(problems_of(monkeypatch, training=training)) == 3


def test_values_of_another_algorithm_or_network_are_no_mistake(monkeypatch):
    """Algorithms of an entry often share a dict of values; those that the chosen ones do not have count for nothing."""
    shared = {"num_envs": 8, "algo.clip": 0.1, "algo.lambda_": 0.5, "network.widths": (8,), "env.speed": 2}
    register(monkeypatch, "odd", training=dict.fromkeys(["td", "ppo", "reinforce", "online"], shared))
    for algo in ("td", "ppo", "reinforce", "online"):
        found = compose(["env=odd", f"algo={algo}", "network=linear"])
        assert (found.run.num_envs, found.env.speed) == (8, 2.0)
        assert getattr(found.algo, "clip", 0.1) == 0.1
        assert getattr(found.algo, "lambda_", 0.5) == 0.5


def test_shipped_training_values_have_no_mistakes():
    for name in envs.SHIPPED:
        compose([f"env={name}"])


@dataclasses.dataclass(frozen=True)
class Rich(Config):
    """Options of every kind."""

    start: tuple[float, float] = option((0.0, 0.5), "where it begins", at_most=1)
    gains: tuple[int, ...] = option((1, 2, 3), "of the servos", at_least=0)
    goals: list[list[float]] = option([[0.5], [1.0, 2.0]], "by task")
    side: Literal["left", "right"] = option("left", "which hand")
    tries: Literal[1, 2, 4] = 4
    name: str = option("robots/left arm", "of the robot")
    pace: int | float | None = None
    plain: float = 3
    text: str = "${oc.env:HOME} 1e-3"


def test_options_of_every_kind_go_through_the_command_line_and_a_file(monkeypatch, tmp_path):
    register(monkeypatch, "odd", config=Rich)
    given = [
        "env.start=[0.25,1]",
        "env.gains=[7]",
        "env.side=right",
        "env.tries=2",
        "env.pace=2.5",
        "env.goals=[[1],[]]",
    ]
    found = compose(["env=odd", "run_dir=runs/${x}", *given])
    assert found.env == Rich(start=(0.25, 1.0), gains=(7,), side="right", tries=2, pace=2.5, goals=[[1.0], []])
    assert found.run.run_dir == "runs/${x}"
    (tmp_path / "config.yaml").write_text(configuration.to_yaml(found), encoding="utf-8")
    assert config_file.load(tmp_path / "config.yaml") == found


@pytest.mark.parametrize(
    ("argument", "problem"),
    [
        ("env.start=[0.25]", "env.start=[0.25]: expected a list of 2 values"),
        ("env.start=[0,2]", "env.start=[0, 2]: must be at most 1"),
        ("env.gains=[1.5]", "env.gains=[1.5]: expected a whole number"),
        ("env.side=up", "env.side=up: expected left or right"),
        ("env.tries=3", "env.tries=3: expected 1 or 2 or 4"),
        ("env.pace=fast", "env.pace=fast: expected a whole number or a number"),
        ("env.goals=[1]", "env.goals=[1]: expected a list such as [64,64]"),
        ("env.text=1", "env.text=1: expected a name"),
    ],
)
def test_values_of_the_wrong_kind_are_one_line(argument, problem, monkeypatch):
    assert problems_of(monkeypatch, [argument], config=Rich) == [problem]


def test_help_has_every_option_also_without_help_of_its_own(monkeypatch, capsys):
    register(monkeypatch, "odd", config=Rich)
    train.main(["env=odd", "--help"])
    lines = capsys.readouterr().out.splitlines()
    for field in dataclasses.fields(Rich):
        assert any(line.startswith(f"  env.{field.name}=") for line in lines)


def config_with(**fields):
    """A dataclass of options: name -> (type, default)."""
    made = [(name, kind, dataclasses.field(default=default)) for name, (kind, default) in fields.items()]
    return dataclasses.make_dataclass("Options", made, bases=(Config,), frozen=True)


@dataclasses.dataclass(frozen=True)
class WithoutLength:
    force: float = 5.0


@dataclasses.dataclass(frozen=True)
class Picky(Config):
    def __post_init__(self):
        if self.speed > 1:
            raise ValueError("speed and episode_length do not go together")


@dataclasses.dataclass
class Unfrozen:
    speed: float = 0.1
    gains: list[float] = option([1.0], "of the servos")
    episode_length: int = 8


DECLARATIONS = {
    "an option called id": (config_with(id=(str, "left")), "an option cannot be called 'id'"),
    "no time limit": (WithoutLength, "it needs an option episode_length"),
    "a time limit that may be none": (config_with(episode_length=(int | None, None)), "episode_length must be an int"),
    "a dict": (config_with(gains=(dict[str, float], None)), "option 'gains' is dict[str, float]: expected int, float"),
    "options within options": (config_with(inner=(Config, Config())), "option 'inner' is Config: expected int, float"),
    "anything": (config_with(what=(object, None)), "option 'what' is object: expected int, float"),
    "a name that means nothing": (config_with(what=("Nothing", 1)), "an annotation of Options cannot be evaluated"),
    "a default of another type": (config_with(gain=(float, "high")), "'gain': its default 'high': expected a number"),
    "letters that no command line has": (
        config_with(länge=(float, 1.0)),
        "option 'länge': expected ASCII",
    ),
    "no dataclass": (dict, "its config must be a dataclass of options, not <class 'dict'>"),
    "an instance": (Config(), "its config must be a dataclass of options, not Config("),
}


@pytest.mark.parametrize("kind", DECLARATIONS)
def test_options_that_cannot_be_given_are_one_line_when_the_environment_is_asked_for(kind, monkeypatch):
    schema, message = DECLARATIONS[kind]
    (problem,) = problems_of(monkeypatch, config=schema)
    assert problem.startswith("env=odd: ")
    assert message in problem
    assert compose(["env=quadratic"]).choices["env"] == "quadratic"  # whatever else is registered


def test_what_the_options_refuse_themselves_is_one_line(monkeypatch):
    assert problems_of(monkeypatch, ["env.speed=2"], config=Picky) == [
        "env: speed and episode_length do not go together"
    ]


@pytest.mark.parametrize("length", [0, -3])
def test_a_time_limit_without_a_range_has_one_all_the_same(length, monkeypatch):
    problems = problems_of(monkeypatch, [f"env.episode_length={length}"], config=Unfrozen)
    assert problems == [f"env.episode_length={length}: it must be at least 1"]


def trained(monkeypatch, capsys, folder, *arguments):
    """Exit status and output of a training in this process."""
    monkeypatch.setattr(sys, "argv", ["jaxpg", *SIZES, *arguments, f"run_dir={folder}"])
    with pytest.raises(SystemExit) as ending:
        run_command(train.main)
    return ending.value.code, capsys.readouterr().out


def test_without_training_values_the_defaults_apply_and_it_is_said(monkeypatch, capsys, tmp_path):
    register(monkeypatch, "odd", config=Unfrozen)
    assert compose(["env=odd"]).choices["algo"] == "td"
    status, output = trained(monkeypatch, capsys, tmp_path / "run", "env=odd")
    assert status == 0
    assert "env=odd has no training values for algo=td: the defaults apply" in output
    assert (
        " ".join(config_file.load(tmp_path / "run" / "config.yaml").to_dict()["env"]) == "id speed gains episode_length"
    )


def test_trainings_in_threads(monkeypatch, tmp_path):
    """As Optuna's jobs and a graphical program have them: Python hears signals in the main thread only."""
    monkeypatch.setattr(cache_folder, "locate", lambda: tmp_path / "cache" / "jaxpg")
    ended = {}

    def train_in(folder):
        ended[folder.name] = train.main(["env=quadratic", "network=linear", *RUN, f"run_dir={folder}"])

    threads = [threading.Thread(target=train_in, args=(tmp_path / name,)) for name in ("first", "second")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert ended == {"first": 0, "second": 0}
    assert outcome(tmp_path / "first") == outcome(tmp_path / "second")


SCRIPT = """
import sys
sys.path[:0] = {paths}
import environments, envs
from jaxpg.__main__ import main, run_command
envs.register("my_point", envs.Entry(environments.Config, environments.Point))
run_command(main)
"""


def test_a_run_says_which_program_knows_its_environment(command_environment, tmp_path):
    script = tmp_path / "my robot.py"
    script.write_text(SCRIPT.format(paths=[p for p in sys.path if p]))

    def ended(*arguments):
        return subprocess.run(
            [sys.executable, *arguments], capture_output=True, text=True, check=False, env=command_environment
        )

    run = tmp_path / "run"
    trained = ended(script, "train", "env=my_point", *SIZES, f"run_dir={run}")
    assert trained.returncode == 0, trained.stderr
    assert f"'{script}' evaluate run={run}" in trained.stdout
    before = tree(run)
    for verb in ("evaluate", "report", "export"):
        foreign = ended("-m", f"jaxpg.{verb}", f"run={run}")
        assert (foreign.returncode, len(foreign.stderr.splitlines())) == (2, 1), foreign.stderr
        assert f"unknown env 'my_point': {script} registers it" in foreign.stderr
        assert f"'{script}' COMMAND" in foreign.stderr
    assert tree(run) == before
    assert ended(script, "evaluate", f"run={run}", "episodes=2").returncode == 0
