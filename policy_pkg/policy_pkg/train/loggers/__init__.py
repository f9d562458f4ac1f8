"""Experiment loggers by the name that ``loggers`` of a training configuration has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from crash_coach_common.contract import UserError
from crash_coach_common.plugins import Plugins
from crash_coach_common.strict_yaml import did_you_mean
from policy_pkg.train.loggers.base import ExperimentLogger, Start, Status
from policy_pkg.train.loggers.mlflow import Mlflow
from policy_pkg.train.loggers.tensorboard import TensorBoard

if TYPE_CHECKING:
    from policy_pkg.train.metrics import Value


def _check(name: str, loaded: Any) -> None:
    if not (isinstance(loaded, type) and issubclass(loaded, ExperimentLogger)):
        raise ValueError(
            f"logger {name} is {loaded!r}; must be a class derived from "
            "policy_pkg.train.loggers.base.ExperimentLogger"
        )


LOGGERS: Plugins[type[ExperimentLogger]] = Plugins(
    "crash_coach.loggers", {"tensorboard": TensorBoard, "mlflow": Mlflow}, _check
)
Make = Callable[[Start], ExperimentLogger]


class Chosen:
    """The loggers that a configuration asks for, as the run tells them.

    Args:
        loggers: of the configuration: by name, whether it is told, or its options.

    Raises:
        UserError: an unknown name or option, a value out of range, a package that is missing; the
            text begins with the key.
    """

    def __init__(self, loggers: Mapping[str, bool | dict[str, Any]]) -> None:
        asked = {name: {} if told is True else told for name, told in loggers.items() if told}
        self._makers = {name: _maker(name, options) for name, options in asked.items()}
        self._made: dict[str, ExperimentLogger] = {}

    def begin(self, start: Start) -> None:
        """Raises UserError where one cannot begin; those that had begun are told so."""
        for name, make in self._makers.items():
            try:
                self._made[name] = make(start)
            except UserError as error:
                self.finalize("failed")
                raise UserError(f"loggers.{name}: {error}") from error

    def log_metrics(self, line: Mapping[str, Value], step: int) -> list[str]:
        """Tells a block's line; returns which of them could not be told, and why."""
        return self._each(lambda logger: logger.log_metrics(line, step), f"metrics at {step} steps")

    def finalize(self, status: Status) -> list[str]:
        """Tells the end; returns as ``log_metrics``."""
        return self._each(lambda logger: logger.finalize(status), f"that the run has {status}")

    def _each(self, tell: Callable[[ExperimentLogger], None], what: str) -> list[str]:
        problems = []
        for name, logger in self._made.items():
            try:
                tell(logger)
            except OSError as error:
                problems.append(f"logger {name} was not told {what}: {error}")
        return problems


def _maker(name: str, given: Mapping[str, Any]) -> Make:
    try:
        kind = LOGGERS[name]
    except KeyError:
        raise UserError(
            f"loggers.{name}: no such logger{did_you_mean(name, tuple(LOGGERS))}; "
            f"known: {', '.join(LOGGERS)}"
        ) from None
    try:
        options = kind.Options.model_validate(given)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            known = sorted(kind.Options.model_fields)
            listed = ", ".join(known) or "it has none"
            hint = did_you_mean(key, known)
            raise UserError(
                f"loggers.{name}: unknown option {key!r}{hint}; known: {listed}"
            ) from error
        raise UserError(f"loggers.{name}.{key} = {problem['input']!r}: {problem['msg']}") from error
    try:
        kind.check()
    except UserError as error:
        raise UserError(f"loggers.{name}: {error}") from error
    return lambda start: kind(start, options)
