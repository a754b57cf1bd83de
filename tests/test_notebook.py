"""The notebook was executed as it stands, and can be again."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parent.parent / "docs" / "from_lesson_to_robot.ipynb"


def code_cells():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def test_the_notebook_was_executed_from_top_to_bottom():
    cells = code_cells()
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} == {"stream", "display_data"}
    assert {output["name"] for output in outputs if output["output_type"] == "stream"} == {"stdout"}
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    said = "".join("".join(output.get("text", "")) for output in outputs)
    assert "relative to the limit, against float64" in said
    assert "mujoco, as c" in said


@pytest.mark.study
def test_the_notebook_runs(command_environment, tmp_path):
    code = "\n".join("".join(cell["source"]) for cell in code_cells())
    environment = command_environment | {"MPLBACKEND": "Agg", "TMPDIR": str(tmp_path)}
    environment |= {"PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "N m" in result.stdout.splitlines()[-1]
