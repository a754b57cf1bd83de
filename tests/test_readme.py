"""What README and docs say can be done, done; the README's two set-up commands are run by `.ci/run`."""

import itertools
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = {path.name: path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]}
README = PAGES["README.md"]
SAVED = {"own_environment.md": {0: "balance.py", 2: "unknown.py"}}  # Python blocks that are files, by their place
PLAYED = {"policy_in_python.md", "deploy.md"}  # pages whose Python is about the run that their commands train
FROM_THE_CLONE = {"README.md", "physics.md"}  # pages whose Python reads files of the repository
SIZES = ("num_envs=2", "eval_episodes=2", "report=false")


def blocks(language, page):
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.DOTALL)


def commands(page):
    """The lines that call Python, but for those that make its environment."""
    lines = [line for block in blocks("bash", page) for line in block.splitlines()]
    return [line for line in lines if line.startswith((".venv/bin/python ", "python "))]


def pages_with(something):
    """As parameters; all but the README belong to the studies."""
    return [
        pytest.param(page, marks=[] if page == "README.md" else [pytest.mark.study])
        for page in PAGES
        if something(page)
    ]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """`place(page)`: a folder with the files that the page speaks of, to run things in."""

    def make(page):
        monkeypatch.chdir(ROOT if page == "README.md" else tmp_path)
        (tmp_path / "robot.xml").write_text((ROOT / "envs/assets/arm.xml").read_text())
        for number, name in SAVED.get(page, {}).items():
            (tmp_path / name).write_text(blocks("python", page)[number])
        return tmp_path

    return make


@pytest.mark.parametrize("page", pages_with(lambda page: blocks("python", page)))
def test_python_examples_run(page, place, command_environment):
    folder = place(page)
    for line in commands(page) if page in PLAYED else []:
        run_command(line, folder, command_environment)
    for number, code in enumerate(blocks("python", page)):
        if number in SAVED.get(page, {}):
            continue
        cwd = ROOT if page in FROM_THE_CLONE else folder
        result = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False)
        assert result.returncode == 0, (code, result.stderr)


def small(arguments):
    """The arguments of a training with a few steps only."""
    resumed = any(argument.startswith("resume=runs/") for argument in arguments)
    kept = [argument for argument in arguments if not argument.startswith("total_steps=")]
    if resumed:
        return [*kept, "total_steps=16", "report=false"]
    given = {argument.partition("=")[0] for argument in kept}
    sizes = [*SIZES, "total_steps=8"] + ([] if "algo=reinforce" in arguments else ["num_steps=2"])
    return [*kept, *(size for size in sizes if size.partition("=")[0] not in given)]


@pytest.mark.parametrize("page", pages_with(commands))
def test_commands_run(page, place, command_environment):
    folder = place(page)
    for line in commands(page):
        run_command(line, folder, command_environment)


def run_command(line, folder, environment):
    _, *arguments = shlex.split(line)
    if {"jaxpg.train", "train"} & set(arguments):
        arguments = small(arguments)
    command = [sys.executable, *arguments]
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, (line, result.stderr)


def test_no_command_is_left_out():
    """A change of the pages' form would leave the tests above with nothing to run."""
    for page in ("README.md", "training.md", "lesson.md", "quick_start.md", "watching.md", "deploy.md"):
        assert len(commands(page)) >= 3, page
    assert len(commands("own_environment.md")) >= 3
    for page, number in {"README.md": 1, "training.md": 2, "physics.md": 3}.items():
        assert len(blocks("python", page)) == number, page
    assert len([line for line in blocks("python", "own_environment.md")[0].splitlines() if line]) == 40


NEEDED = {"format=all": "onnx", "format=onnx": "onnx", "policy=onnx": "onnxruntime", "backend=gymnasium": "gymnasium"}


@pytest.mark.parametrize("page", ["README.md", "quick_start.md"])
def test_the_set_up_installs_what_the_commands_need(page):
    """Of every page: they are read after one of these."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    (setup,) = re.findall(r"^python3 -m venv .* -e (\S+)(?: && .*jaxpg.train.*)?$", PAGES[page], re.MULTILINE)
    chosen = setup.strip("'").removeprefix(".").strip("[]").split(",")
    installed = " ".join(package for extra in chosen if extra for package in extras[extra])
    used = {name for line in itertools.chain(*map(commands, PAGES)) for name in line.split() if name in NEEDED}
    assert used >= {"format=all", "policy=onnx", "backend=gymnasium"}
    assert not [name for name in used if NEEDED[name] not in installed]


def test_pages_can_be_followed_one_after_the_other():
    """No two commands begin a run in the same folder; no command needs another Python than that of the set-up."""
    lines = [line for page in PAGES for line in commands(page)]
    begun = [name for line in lines if "resume=auto" not in line for name in re.findall(r" run_dir=(\S+)", line)]
    assert len(begun) >= 6
    assert sorted(begun) == sorted(set(begun))
    assert all(line.startswith(".venv/bin/python ") for line in lines)


def test_ci_runs_the_set_up_commands():
    setup = [line for block in blocks("bash", "README.md") for line in block.splitlines() if line.startswith("python3")]
    assert len(setup) == 2
    assert setup[0].endswith("-m jaxpg.train env=pendulum")
    assert setup[1].endswith("-m pytest")
    script = (ROOT / ".ci" / "run").read_text()
    assert "README.md" in script


@pytest.mark.parametrize("page", PAGES)
def test_named_files_exist(page):
    for path in re.findall(r"(?:experiments|docs|tests|envs)/[\w/]+\.\w+", PAGES[page]):
        assert (ROOT / path).exists(), path
    for path in re.findall(r"\]\((?!http)([\w./]+)", PAGES[page]):
        assert ((ROOT / page).parent if page == "README.md" else ROOT / "docs").joinpath(path).exists(), path
