"""Experiment loggers: what they are told, what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from small_run import small

from crash_coach_common.contract import UserError
from policy_pkg.train import loggers
from policy_pkg.train.config import load_train_config
from policy_pkg.train.loggers import mlflow as mlflow_logger
from policy_pkg.train.loggers.base import ExperimentLogger, NoOptions, Start, Status
from policy_pkg.train.run import EndedEarly, train
from policy_pkg.train.run_dir import read_run

PAGE = Path(__file__).resolve().parents[3] / "docs" / "loggers.md"


class Heard(ExperimentLogger):
    """Keeps what it is told, of all runs."""

    told: list[tuple[Any, ...]] = []  # noqa: RUF012 - shared on purpose

    def __init__(self, start: Start, options: NoOptions) -> None:
        assert start.settings["learner.hidden"] == 16
        self.told.append(("start", start.step))

    def log_metrics(self, line: Mapping[str, Any], step: int) -> None:
        self.told.append((line["env_steps"], step))

    def finalize(self, status: Status) -> None:
        self.told.append((status,))


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    monkeypatch.setattr(Heard, "told", [])
    monkeypatch.setattr(loggers, "LOGGERS", {**loggers.LOGGERS, "heard": Heard})
    return Heard.told


HEARD = {"tensorboard": False, "heard": True}


def test_a_stopped_run_is_told_on_where_it_was(
    heard: list[tuple[Any, ...]], tmp_path: Path
) -> None:
    config = small(loggers=HEARD, total_steps=900)
    asked = iter([False] * 100 + [True])
    with pytest.raises(EndedEarly):
        train(config, tmp_path / "run", stopped=lambda: next(asked))
    assert heard == [("start", 0), (0, 0), (300, 300), ("stopped",)]
    heard.clear()
    train(config, tmp_path / "run", resume=True)
    assert heard == [("start", 400), (600, 600), (900, 900), ("finished",)]
    heard.clear()
    train(config, tmp_path / "run", resume=True)  # finished already: nothing to tell
    assert heard == []


def test_an_error_is_told_too(heard: list[tuple[Any, ...]], tmp_path: Path) -> None:
    def fail(report: object) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        train(small(loggers=HEARD), tmp_path / "run", progress=fail)
    assert heard[-1] == ("failed",)


def test_the_logger_of_the_page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = re.findall(r"```python\n(# my_loggers.*?)```", PAGE.read_text(), flags=re.DOTALL)
    module: dict[str, Any] = {"__name__": "my_loggers"}
    exec(found[0], module)
    monkeypatch.setattr(loggers, "LOGGERS", {"table": module["Table"], **loggers.LOGGERS})
    table = {"file": str(tmp_path / "successes.txt")}
    told = {"tensorboard": False, "table": {**table, "digits": 3}}
    train(small(loggers=told, total_steps=300), tmp_path / "run")
    rows = (tmp_path / "successes.txt").read_text().splitlines()
    assert rows[0] == "# run, seed 0, from step 0"
    assert re.fullmatch(r"300 \d\.\d{3}", rows[2])
    assert rows[3:] == ["# finished"]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("mlflo=true", r"loggers\.mlflo: no such logger \(did you mean 'mlflow'\?\)"),
        ("mlflow.experimnt=a", r"loggers\.mlflow: unknown option 'experimnt' \(did you mean"),
        ("mlflow.experiment=3", r"loggers\.mlflow\.experiment = 3: Input should be a valid str"),
        ("tensorboard.x=3", r"loggers\.tensorboard: unknown option 'x'; known: it has none"),
        ("tensorboard=maybe", r"loggers: tensorboard = 'maybe': must be true, false, or"),
    ],
)  # fmt: skip
def test_what_no_logger_understands_is_named(override: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        load_train_config("buttons/qmix", [f"loggers.{override}"])


def test_a_missing_package_is_named_before_anything_is_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(mlflow_logger, "find_spec", lambda package: None)
    expected = r"loggers\.mlflow: it needs the extra package mlflow: install it with `make mlflow`"
    with pytest.raises(UserError, match=expected):
        load_train_config("buttons/qmix", ["loggers.mlflow=true"])
    with pytest.raises(UserError, match=expected):
        train(small(loggers={"mlflow": True}), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_of_when_tensorboard_was_the_only_logger_goes_on(tmp_path: Path) -> None:
    run, config = tmp_path / "run", small(total_steps=300)
    train(config, run)
    about = json.loads((run / "run.json").read_text())
    del about["config"]["loggers"]
    about["config"]["tensorboard"] = False
    (run / "run.json").write_text(json.dumps(about))
    assert read_run(run)["config"]["loggers"] == {"tensorboard": False}
    assert train(config, run, resume=True).steps == 300
