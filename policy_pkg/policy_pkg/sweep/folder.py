"""A sweep's folder: where each run's files lie, and how far each run is.

::

    3s_vs_5z/adaptive-s0/        a run directory
    3s_vs_5z/adaptive-s0.log     what its processes wrote
    .sweep/lock                  held while a sweep works here
    .sweep/mark                  by which another machine knows that it sees this folder
    .sweep/3s_vs_5z/adaptive-s0.lock, .progress    of one run
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from crash_coach_common.locks import TakenError, held
from policy_pkg.sweep.config import SweepRun
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run_dir import RUN, RunError, check_same, newest_step, read_run

HIDDEN = ".sweep"
# Where it matters not for what is learned, a run may have been done with another setting.
NO_MATTER = {"loggers", "checkpoint_interval_steps", "checkpoint_replay"}

Kind = Literal["finished", "kept", "started", "new"]


@dataclass(frozen=True)
class Standing:
    """How far a run is. ``path``: where it lies; ``kept``: finished, in another folder.

    remark: why something of that name in another folder does not count.
    """

    kind: Kind
    steps: int
    path: Path
    remark: str | None = None

    @property
    def done(self) -> bool:
        return self.kind in ("finished", "kept")


@dataclass(frozen=True)
class RunProgress:
    """What a run's process last said; ``warning``: what went wrong and was survived."""

    env_steps: int
    total_steps: int
    steps_per_s: float
    alpha: float
    success_rate: float | None
    warning: str | None = None


@dataclass(frozen=True)
class RunFiles:
    """The files of one run."""

    out: Path
    name: str

    @property
    def folder(self) -> Path:
        return self.out / self.name

    @property
    def log(self) -> Path:
        return self.out / f"{self.name}.log"

    @property
    def lock(self) -> Path:
        return self.out / HIDDEN / f"{self.name}.lock"

    @property
    def progress(self) -> Path:
        return self.out / HIDDEN / f"{self.name}.progress"

    def prepare(self) -> None:
        """Makes the folders above, and forgets what an earlier process said.

        Raises:
            OSError: it cannot be written.
        """
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self.lock.parent.mkdir(parents=True, exist_ok=True)
        self.progress.unlink(missing_ok=True)


def write_progress(path: Path, progress: RunProgress) -> None:
    """Raises OSError."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(asdict(progress)), encoding="utf-8")
    partial.replace(path)


def read_progress(path: Path) -> RunProgress | None:
    """None where the process has said nothing yet, or a network's disk has nothing to read now.

    Raises:
        RunError: something else lies there.
    """
    try:
        return RunProgress(**json.loads(path.read_text(encoding="utf-8")))
    except OSError:
        return None
    except (ValueError, TypeError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error


def standing(run: SweepRun, out: Path, have: Sequence[Path] = ()) -> Standing:
    """How far ``run`` is.

    Args:
        have: folders in which a finished run of the same name and configuration counts too, as
            <scenario>/<method>-s<seed> or <method>-s<seed>.

    Raises:
        RunError: its folder holds a run of another configuration; names the key.
    """
    folder = out / run.name
    steps: int | None = None
    if (folder / RUN).exists():
        check_same(read_run(folder), run.config, folder)
        steps = newest_step(folder)
        if steps >= run.config.total_steps:
            return Standing("finished", steps, folder)
    remark = None
    for place in (path for root in have for path in (root / run.name, root / folder.name)):
        if (place / RUN).exists():
            remark = _why_not(run, place)
            if remark is None:
                return Standing("kept", newest_step(place), place)
    if steps is None:
        return Standing("new", 0, folder, remark)
    return Standing("started", steps, folder, remark)


def _why_not(run: SweepRun, place: Path) -> str | None:
    """Why the run in ``place`` is not a finished ``run``; None: it is."""
    content = read_run(place)
    try:
        # A default that came later is filled in.
        config = TrainConfig.model_validate(content.get("config"))
    except ValidationError:
        return f"{place} is of another kind"
    same = {key: getattr(run.config, key) for key in NO_MATTER}
    found = config.model_copy(update=same).model_dump(mode="json")
    try:
        check_same({"config": found}, run.config, place)
    except RunError as error:
        return str(error).split(": ")[0]
    steps = newest_step(place)
    if steps < run.config.total_steps:
        return f"{place} is not finished: {steps:,} of {run.config.total_steps:,} steps"
    return None


def leave_mark(out: Path) -> str:
    """Writes something into the sweep's folder that no other has; returns it.

    Raises:
        OSError: it cannot be written.
    """
    mark = uuid.uuid4().hex
    (out / HIDDEN).mkdir(parents=True, exist_ok=True)
    (out / HIDDEN / "mark").write_text(mark, encoding="utf-8")
    return mark


def check_mark(out: str, mark: str) -> None:
    """Raises RunError where this machine's ``out`` is not that in which ``mark`` was left."""
    path = Path(out) / HIDDEN / "mark"
    try:
        found = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RunError(f"it does not see {path}: {error.strerror}") from error
    if found != mark:
        raise RunError(f"its {path} is another file")


@contextmanager
def exclusive(
    path: Path, wait_s: float, taken: str, waiting: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Holds the lock file ``path``; ends with the process at the latest.

    Args:
        wait_s: how long it may be held by another process.
        taken: what to say of what the lock is for, should that last longer.
        waiting: called once, before the wait.

    Raises:
        RunError: it was held for longer; says by whom.
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with held(path, wait_s, waiting):
            yield
    except TakenError as error:
        raise RunError(f"{taken} by another process ({error})") from None
