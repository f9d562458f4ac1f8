"""What an experiment logger is: somebody beside the run's own files who is told how it trains.

Another package adds one through the entry point group ``crash_coach.loggers`` (docs/loggers.md).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from crash_coach_common.strict_yaml import StrictModel

if TYPE_CHECKING:  # configurations are read with loggers known, and metrics with configurations
    from policy_pkg.train.metrics import Value

Status = Literal["finished", "stopped", "failed"]
"""How a run ended: with its last step, earlier because it was asked to, or by an error."""


@dataclass(frozen=True)
class Start:
    """A run that begins, or goes on.

    out_dir: its folder. settings: its configuration, flat: ``learner.lr``. about: what its
    ``run.json`` says: versions, commit, command. step: steps done. Of a run that was killed, later
    ones may have been told of already; they are told again.
    """

    out_dir: Path
    settings: Mapping[str, Any]
    about: Mapping[str, Any]
    step: int


class NoOptions(StrictModel):
    """Of a logger that has none."""


class ExperimentLogger(ABC):
    """Told of one run, in its process; made anew where the run is resumed.

    ``Options``: the schema of what stands under its name in ``loggers``.
    """

    Options: ClassVar[type[StrictModel]] = NoOptions

    @classmethod
    def check(cls) -> None:
        """Raises UserError where it cannot be used here, a package that it needs missing for one.

        Called before anything of the run is written.
        """
        return

    @abstractmethod
    def __init__(self, start: Start, options: Any) -> None:
        """Raises UserError where it cannot begin: nothing is trained then."""

    @abstractmethod
    def log_metrics(self, line: Mapping[str, Value], step: int) -> None:
        """An evaluation block's line of ``metrics.jsonl``, at ``step``.

        Raises:
            OSError: it could not be told. The user hears of it, and training goes on.
        """

    @abstractmethod
    def finalize(self, status: Status) -> None:
        """The run has ended; not called where its process was killed. Raises as ``log_metrics``."""
