"""What the README and docs/deploy.md say can be done, done; the two set-up commands are run by `.ci/run`."""

import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README, DEPLOY = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/deploy.md"))


def blocks(language, text=README):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def test_python_examples_run():
    assert len(blocks("python")) == 3
    for code in blocks("python"):
        exec(compile(code, "README.md", "exec"), {})


@pytest.mark.parametrize(("text", "number"), [(README, 10), pytest.param(DEPLOY, 4, marks=pytest.mark.study)])
def test_commands_run(command, tmp_path, text, number):
    """Each with a few steps only; run folders below a temporary folder."""
    blocks_of_commands = blocks("bash", text)
    lines = [line for block in blocks_of_commands for line in block.splitlines() if "/python -m jaxpg" in line]
    lines = [line for line in lines if not line.startswith("python3 -m venv")]
    assert len(lines) == number
    tiny = ["num_envs=2", "num_steps=2", "eval_episodes=2"]
    for line in lines:
        _, _, module, *arguments = shlex.split(line)
        arguments = [re.sub(r"=runs/", f"={tmp_path}/", argument) for argument in arguments]
        if "train" in module:
            arguments = [argument for argument in arguments if not argument.startswith("total_steps=")]
            arguments += [f"total_steps={8 if 'resume=' in line else 4}"]
            arguments += [] if "resume=runs/" in line else tiny
        result = command(module.removeprefix("jaxpg."), *arguments)
        assert result.returncode == 0, (line, result.stderr)


def test_ci_runs_the_set_up_commands():
    setup = [line for block in blocks("bash") for line in block.splitlines() if line.startswith("python3 -m venv")]
    assert len(setup) == 2
    assert setup[0].endswith("-m jaxpg.train env=pendulum")
    assert setup[1].endswith("-m pytest")
    script = (ROOT / ".ci" / "run").read_text()
    assert "README.md" in script


def test_named_files_exist():
    for path in re.findall(r"(?:experiments|docs)/[\w/]+\.\w+", README + DEPLOY):
        assert (ROOT / path).exists(), path
