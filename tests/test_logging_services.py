"""The real Weights & Biases and MLflow, off line: read back, they have what `metrics.jsonl` has, each step once."""

import fcntl
import importlib.util
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import LINES, RUN, has_written, stop_after, training

from jaxpg.store import folder
from jaxpg.store.folder import RunFolder
from jaxpg.store.loggers import follower, mean_values
from jaxpg.store.metrics_log import MetricsLog


def installed():
    """The services that can be tried here; MLflow with a store of files, which needs no database."""
    return [name for name in ("wandb", "mlflow") if importlib.util.find_spec(name)]


@pytest.fixture(scope="module")
def interrupted(command_environment, tmp_path_factory):
    """A run that was killed, resumed and stopped by Ctrl-C, with the real services off line."""
    if not installed():
        pytest.skip("neither wandb nor mlflow is installed")
    run_folder = RunFolder(tmp_path_factory.mktemp("runs") / "interrupted")
    store = f"file://{run_folder.path.parent / 'store'}"
    offline = {"WANDB_MODE": "offline", "MLFLOW_ALLOW_FILE_STORE": "true", "MLFLOW_TRACKING_URI": store}
    environment = {name: text for name, text in command_environment.items() if not name.startswith("WANDB_")} | offline
    loggers = f"loggers=[{','.join(installed())}]"
    with training(environment, *RUN, loggers, f"run_dir={run_folder.path}") as process:
        stop_after(process, run_folder.path, LINES // 4 + 5)
    command = [sys.executable, "-m", "jaxpg.train", f"resume={run_folder.path}"]
    terminal = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(command, env=environment, **terminal) as process:
        assert has_written(process, run_folder.path, LINES // 2), process.communicate()
        os.killpg(process.pid, signal.SIGINT)  # to all that a terminal would send it to
        output = process.communicate()
        assert process.returncode == 130, output
    wait_for_senders(run_folder)
    return run_folder, store, folder.read_metrics(run_folder), output


def wait_for_senders(run_folder):
    """On a busy machine they may have been left to go on by themselves."""
    for name in installed():
        with (run_folder.loggers / f"{name}.log").open() as log:
            fcntl.flock(log, fcntl.LOCK_EX)


def expected(lines):
    """What services have of the lines; the seconds of repeated ones are those of the first time."""
    return [(line["steps"], {k: v for k, v in mean_values(line).items() if k != "seconds"}) for line in lines]


def test_services_make_no_noise(interrupted):
    *_, (out, error) = interrupted
    assert error == ""
    said = [line.lower() for line in out.splitlines() if "continues for at most" not in line]
    assert not any(word in line for line in said for word in ("wandb", "mlflow", "note"))


def records(path):
    """The records of a W&B file: LevelDB's log format, in blocks of 32 kB, and W&B's protocol in it.

    wandb has no public reader; where its format changes, this fails.
    """
    from wandb.proto.wandb_internal_pb2 import Record

    data, position, record = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        left = 32768 - position % 32768
        if left < 7:
            position += left
            continue
        size, kind = int.from_bytes(data[position + 4 : position + 6], "little"), data[position + 6]
        record += data[position + 7 : position + 7 + size]
        position += 7 + size
        if kind in (1, 4):  # the whole, or the last part
            yield Record.FromString(record)
            record = b""


def test_weights_and_biases_has_each_step_once(interrupted):
    """The parts of the run together, in the order of their times, as `wandb sync` takes them."""
    pytest.importorskip("wandb")
    run_folder, _, lines, _ = interrupted
    files = sorted((run_folder.loggers / "wandb").glob("offline-run-*/*.wandb"))
    assert len(files) == 2
    found = [record for path in files for record in records(path)]
    history = [record.history for record in found if record.WhichOneof("record_type") == "history"]
    logged = []
    for entry in history:
        items = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in entry.item}
        values = {name: value for name, value in items.items() if not name.startswith("_") and name != "seconds"}
        logged.append((items["_step"], values))
    assert logged == expected(lines)
    runs = [record.run for record in found if record.WhichOneof("record_type") == "run"]
    assert {run.run_id for run in runs} == {json.loads((run_folder.loggers / "wandb.json").read_text())["id"]}
    assert runs[0].display_name == run_folder.path.name
    assert {item.key for item in runs[0].config.update} >= {"env", "algo", "seed", "total_steps"}
    assert not any(run.host or run.git.remote_url or run.git.commit for run in runs)
    kinds = {record.WhichOneof("record_type") for record in found}
    assert not kinds & {"stats", "output", "output_raw", "environment", "files"}


def mlflow_points(client, run_id):
    """The metrics of an MLflow run by step, each a list."""
    points = {}
    for name in client.get_run(run_id).data.metrics:
        for metric in client.get_metric_history(run_id, name):
            points.setdefault(metric.step, {}).setdefault(name, []).append(metric.value)
    return points


def test_mlflow_has_each_step_once(interrupted, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    run_folder, store, lines, _ = interrupted
    client = mlflow.MlflowClient(store)
    (run,) = client.search_runs([client.get_experiment_by_name("jaxpg").experiment_id])
    points = mlflow_points(client, run.info.run_id)
    assert all(len(values.pop("seconds")) == 1 for values in points.values())
    assert points == {step: {name: [value] for name, value in values.items()} for step, values in expected(lines)}
    assert (run.info.run_name, run.info.status) == (run_folder.path.name, "FINISHED")
    assert run.data.params["env.id"] == "quadratic"
    assert not [tag for tag in run.data.tags if "source" in tag or "git" in tag]


def log_to_mlflow(run_folder, updates, done=0):
    log = MetricsLog(run_folder, done, print, ["mlflow"])
    for update in updates:
        log.write({"update": update, "steps": 8 * update, "return": 1.0, "seconds": 0.5 * update})
    log.close()


@pytest.mark.study  # MLflow takes ten seconds to make its database
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # its own, of SQLAlchemy
def test_mlflow_has_a_database_of_its_own_where_none_is_named(tmp_path, monkeypatch):
    """In the folder where the training was started; a run that is resumed elsewhere goes on in it."""
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("alembic")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.setattr(follower, "CLOSE_TIMEOUT", 120.0)
    run_folder = RunFolder(tmp_path / "run")
    run_folder.path.mkdir()
    run_folder.config.write_text("seed: 3\n")
    monkeypatch.chdir(tmp_path)
    log_to_mlflow(run_folder, [1, 2, 3])
    assert Path("mlflow.db").exists()
    monkeypatch.chdir(run_folder.path)
    log_to_mlflow(run_folder, [3, 4], done=2)
    assert not Path("mlflow.db").exists()
    run_id = json.loads((run_folder.loggers / "mlflow.json").read_text())["run_id"]
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")
    points = mlflow_points(client, run_id)
    assert {step: values["seconds"] for step, values in points.items()} == {8 * n: [0.5 * n] for n in (1, 2, 3, 4)}
