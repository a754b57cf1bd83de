"""Metrics for MLflow."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from jaxpg.store import files

FLUSH_INTERVAL = 2.0  # seconds; a database takes some 30 ms for one line, and for sixty 150
BATCH = 1000  # metrics that MLflow takes at once
PARAMS = 100  # parameters that it takes at once
LAST = "seconds"  # the last metric of a line: where it is, the line is


def packages() -> tuple[str, ...]:
    """A store on this machine, which is the default, is a database."""
    return ("mlflow",) if os.environ.get("MLFLOW_TRACKING_URI") else ("mlflow", "sqlalchemy", "alembic")


class MLflow:
    """An MLflow run: the configuration as parameters, the name of the run folder and the metrics, by environment steps.

    It goes where MLFLOW_TRACKING_URI says. Without that it goes where `mlflow ui`, started in the same folder as the
    training, looks for it: into the database `mlflow.db` there, by MLflow's own default; a resumed run goes on in
    the database that it began in. The experiment is MLFLOW_EXPERIMENT_NAME, by default `jaxpg`.

    MLflow takes a step twice without a word, so on resume it is asked which is its last; the run's id is kept in
    `mlflow.json`. Where the store does not know the run, being another one, a new one begins there. Parameters stay
    those that the run began with: MLflow does not let them change.

    Args:
      folder: for `mlflow.json`.
      name: of the run.
      config: of the run.
    """

    def __init__(self, folder: Path, name: str, config: Mapping[str, Any]):
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        import mlflow

        path = folder / "mlflow.json"
        kept = json.loads(files.read(path)) if os.path.lexists(path) else {}
        given = os.environ.get("MLFLOW_TRACKING_URI")  # not kept: it may have a password in it
        default = None if given else kept.get("tracking_uri") or mlflow.get_tracking_uri()
        self._client = mlflow.MlflowClient(given or default)
        self._run_id = _found(self._client, kept.get("run_id")) or _created(self._client, name, config)
        files.replace(path, json.dumps({"run_id": self._run_id, "tracking_uri": default}).encode())
        history = self._client.get_metric_history(self._run_id, LAST)
        self.last = max((metric.step for metric in history), default=-1)
        self._waiting: list[Any] = []
        self._flushed = 0.0

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Adds values at a step."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        if len(self._waiting) + len(values) > BATCH:
            self._flush()
        ordered = sorted(values.items(), key=lambda item: item[0] == LAST)
        self._waiting += [Metric(name, value, now, step) for name, value in ordered]
        if time.monotonic() - self._flushed > FLUSH_INTERVAL:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._client.set_terminated(self._run_id)

    def _flush(self) -> None:
        self._client.log_batch(self._run_id, metrics=self._waiting)
        self._waiting, self._flushed = [], time.monotonic()


def _found(client: Any, run_id: str | None) -> str | None:
    """The run, going on again, if the store has it."""
    from mlflow.exceptions import MlflowException

    if run_id is None:
        return None
    try:
        client.update_run(run_id, status="RUNNING")
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
        return None
    return run_id


def _created(client: Any, name: str, config: Mapping[str, Any]) -> str:
    from mlflow.entities import Param

    experiment = os.environ.get("MLFLOW_EXPERIMENT_NAME", "jaxpg")
    found = client.get_experiment_by_name(experiment)
    experiment_id = found.experiment_id if found else client.create_experiment(experiment)
    run_id = client.create_run(experiment_id, run_name=name).info.run_id
    params = [Param(key, str(value)) for key, value in _flat(config)]
    for first in range(0, len(params), PARAMS):
        client.log_batch(run_id, params=params[first : first + PARAMS])
    return run_id


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """All values by their names on the command line."""
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


begin = MLflow
