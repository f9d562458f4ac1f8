"""The metrics as a run of MLflow (an extra: requirements-mlflow.lock)."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from crash_coach_common.contract import UserError
from crash_coach_common.locks import TakenError, held
from crash_coach_common.strict_yaml import StrictModel
from crash_coach_common.whole_output import write_whole
from policy_pkg.train.loggers.base import ExperimentLogger, Start, Status

if TYPE_CHECKING:
    from policy_pkg.train.metrics import Value

KEPT = "mlflow.json"  # in the run's folder: which run of MLflow's it is
STORE = "mlflow.db"
SQLITE = "sqlite:///"
MADE_S = 300.0  # how long another process may take to make a store
PARAMETERS_AT_ONCE = 100  # MLflow takes no more in one call
STATUS: Mapping[Status, str] = {"finished": "FINISHED", "stopped": "KILLED", "failed": "FAILED"}
# Read when MLflow is imported. Nothing is sent to its makers, its migrations are not told of, and a
# server that does not answer holds training up for seconds, not for minutes.
SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}


class MlflowOptions(StrictModel):
    experiment: str = Field("crash-coach", min_length=1, description="MLflow's experiment")
    tracking_uri: str | None = Field(
        None,
        min_length=1,
        description="where MLflow keeps runs; null: $MLFLOW_TRACKING_URI where that is set, or "
        f"else the SQLite file {STORE} beside the run's folder",
    )


class Mlflow(ExperimentLogger):
    """The configuration as parameters, every number of a metrics line under its key.

    A run that is resumed goes on with the run of MLflow's that it began.

    Raises:
        UserError: MLflow's store cannot be used, or has lost the run that is to go on.
    """

    Options = MlflowOptions

    @classmethod
    def check(cls) -> None:
        for package in ("mlflow", "sqlalchemy", "alembic"):
            if find_spec(package) is None:
                raise UserError(
                    f"it needs the extra package {package}: install it with `make mlflow`, or with "
                    "`pip install -r requirements-mlflow.lock`"
                )

    def __init__(self, start: Start, options: MlflowOptions) -> None:
        for name, value in SETTINGS.items():
            os.environ.setdefault(name, value)
        # Imported here: it takes seconds.
        from mlflow.entities import Metric, Param
        from mlflow.exceptions import MlflowException
        from mlflow.tracking import MlflowClient
        from sqlalchemy.exc import SQLAlchemyError

        self._metric, self._param = Metric, Param
        self._error, self._errors = MlflowException, (MlflowException, SQLAlchemyError)
        store = options.tracking_uri or os.environ.get("MLFLOW_TRACKING_URI")
        self._store = store or f"{SQLITE}{start.out_dir.resolve().parent / STORE}"
        kept = start.out_dir / KEPT
        try:
            with self._alone(), self._as_os_error():
                self._client = MlflowClient(tracking_uri=self._store)
                self._run = self._again(kept) if kept.exists() else self._begin(start, options)
        except (OSError, TakenError) as error:
            raise UserError(f"MLflow's store {self._store}: {error}") from error
        write_whole(kept, (json.dumps({"run_id": self._run}) + "\n").encode())

    def _alone(self) -> AbstractContextManager[None]:
        """While a store in a file is made: MLflow lets two processes do so at once, which fails."""
        if not self._store.startswith(SQLITE):
            return nullcontext()
        file = Path(self._store.removeprefix(SQLITE))
        return held(file.with_name(f"{file.name}.lock"), MADE_S)

    @contextmanager
    def _as_os_error(self) -> Iterator[None]:
        try:
            yield
        except self._errors as error:
            raise OSError(str(error).partition("\n")[0]) from error

    def _begin(self, start: Start, options: MlflowOptions) -> str:
        about, name = start.about, options.experiment
        known = self._client.get_experiment_by_name(name)
        made = self._client.create_experiment(name) if known is None else known.experiment_id
        # MLflow's own tags: what its pages show as a run's source and version.
        tags = {"mlflow.source.name": " ".join(about["command"])}
        if about["commit"] is not None:
            tags["mlflow.source.git.commit"] = about["commit"].partition("+")[0]
        run: str = self._client.create_run(made, run_name=start.out_dir.name, tags=tags).info.run_id
        settings = {**start.settings, **about["versions"]}
        parameters = [self._param(key, str(value)) for key, value in settings.items()]
        for first in range(0, len(parameters), PARAMETERS_AT_ONCE):
            self._client.log_batch(run, params=parameters[first : first + PARAMETERS_AT_ONCE])
        return run

    def _again(self, kept: Path) -> str:
        run: str = json.loads(kept.read_text(encoding="utf-8"))["run_id"]
        try:
            self._client.update_run(run, status="RUNNING")
        except self._error as error:
            raise UserError(
                f"MLflow's store {self._store} has no run {run}, which {kept} says this run is: "
                f"restore the store, or remove {kept} to begin another there ({error})"
            ) from error
        return run

    def log_metrics(self, line: Mapping[str, Value], step: int) -> None:
        now_ms = int(time.time() * 1000)
        numbers: list[Any] = [
            self._metric(key, value, now_ms, step)
            for key, value in line.items()
            if isinstance(value, int | float)
        ]
        with self._as_os_error():
            self._client.log_batch(self._run, metrics=numbers)

    def finalize(self, status: Status) -> None:
        with self._as_os_error():
            self._client.set_terminated(self._run, STATUS[status])
