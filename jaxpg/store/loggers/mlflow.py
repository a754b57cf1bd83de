"""Metrics for MLflow."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from jaxpg.store import files

FLUSH_INTERVAL = 2.0  # seconds; a database takes about 30 ms for one line, and 150 ms for sixty
MAX_METRICS = 1000  # per call of MLflow
MAX_PARAMS = 100  # per call of MLflow
LAST_METRIC = "seconds"  # written last: if it is there, the whole line is


def packages() -> tuple[str, ...]:
    """The default, a local store, needs a database."""
    return ("mlflow",) if os.environ.get("MLFLOW_TRACKING_URI") else ("mlflow", "sqlalchemy", "alembic")


class MLflow:
    """An MLflow run: the configuration as parameters, the name of the run folder and the metrics, by environment steps.

    MLFLOW_TRACKING_URI says where it goes. By MLflow's default it is the database `mlflow.db` in the folder where the
    training starts, in which `mlflow ui` finds it; a resumed run stays in the database it began in. The experiment is
    MLFLOW_EXPERIMENT_NAME, by default `jaxpg`.

    MLflow silently accepts a step twice, so on resume its last step is looked up; the run's id is kept in
    `mlflow.json`. If the store does not know the run, a new one begins there. Parameters stay as they were at first:
    MLflow does not let them change.

    Args:
      folder: folder for `mlflow.json`.
      name: name of the run.
      config: options of the run.
    """

    def __init__(self, folder: Path, name: str, config: Mapping[str, Any]):
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        import mlflow

        path = folder / "mlflow.json"
        record = json.loads(files.read(path)) if os.path.lexists(path) else {}
        tracking_uri = os.environ.get("MLFLOW_TRACKING_URI")  # not stored, as it may contain a password
        default = None if tracking_uri else record.get("tracking_uri") or mlflow.get_tracking_uri()
        self._client = mlflow.MlflowClient(tracking_uri or default)
        self._run_id = _reopen(self._client, record.get("run_id")) or _create(self._client, name, config)
        files.replace(path, json.dumps({"run_id": self._run_id, "tracking_uri": default}).encode())
        history = self._client.get_metric_history(self._run_id, LAST_METRIC)
        self.last = max((metric.step for metric in history), default=-1)
        self._waiting: list[Any] = []
        self._flushed = 0.0

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Adds values at a step."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        if len(self._waiting) + len(values) > MAX_METRICS:
            self._flush()
        ordered = sorted(values.items(), key=lambda item: item[0] == LAST_METRIC)
        self._waiting += [Metric(name, value, now, step) for name, value in ordered]
        if time.monotonic() - self._flushed > FLUSH_INTERVAL:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._client.set_terminated(self._run_id)

    def _flush(self) -> None:
        self._client.log_batch(self._run_id, metrics=self._waiting)
        self._waiting, self._flushed = [], time.monotonic()


def _reopen(client: Any, run_id: str | None) -> str | None:
    """The run, marked as running again, if the store knows it."""
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


def _create(client: Any, name: str, config: Mapping[str, Any]) -> str:
    from mlflow.entities import Param

    experiment = os.environ.get("MLFLOW_EXPERIMENT_NAME", "jaxpg")
    existing = client.get_experiment_by_name(experiment)
    experiment_id = existing.experiment_id if existing else client.create_experiment(experiment)
    run_id = client.create_run(experiment_id, run_name=name).info.run_id
    params = [Param(key, str(value)) for key, value in _flatten(config)]
    for first in range(0, len(params), MAX_PARAMS):
        client.log_batch(run_id, params=params[first : first + MAX_PARAMS])
    return run_id


def _flatten(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """All values with their command-line names."""
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


begin = MLflow
