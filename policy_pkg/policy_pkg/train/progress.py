"""What a run tells those who watch it; they may be processes without torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from policy_pkg.train.metrics import Value

Phase = Literal["training", "evaluation", "checkpoint", "finished"]


@dataclass(frozen=True)
class ProgressReport:
    """Where a run stands; from the first step on, the callback gets one a few times per second.

    steps, total_steps: environment steps, or gradient steps of a run on recordings.
    alpha, epsilon: None where the session decides neither.
    success_rate, success_crash_free: of the last evaluation block; None where not measured.
    steps_per_s, eta_s: from the last seconds; 0 for a finished run that was resumed.
    warning: something that the user should know, or that was survived; reported once.
    """

    phase: Phase
    steps: int
    total_steps: int
    alpha: float | None
    epsilon: float | None
    success_rate: float | None
    success_crash_free: float | None
    steps_per_s: float
    eta_s: float
    warning: str | None = None


@dataclass(frozen=True)
class RunSummary:
    """A finished run. wall_s: of this process, 0 where the run was finished already."""

    out_dir: Path
    checkpoint: Path
    steps: int
    episodes: int
    gradient_steps: int
    wall_s: float
    last_block: dict[str, Value]


OnProgress = Callable[[ProgressReport], None]


def silent(report: ProgressReport) -> None: ...
