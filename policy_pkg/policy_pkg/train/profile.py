"""Where a training run's time goes: the real loop of ``trainer.train``, with timers in its seams.

The timers are put over methods of one run's own objects, so that no other run has any. Time inside
a part that another part calls counts for the inner one only: the parts and the rest add up to all.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crash_coach_common.contract import UserError
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.progress import ProgressReport
from policy_pkg.train.run import Clock, train
from policy_pkg.train.session import TrainSession
from sim_pkg.env import Env

REST = "rest"
PHYSICS, SIMULATOR, INFERENCE, ROLLOUT = "physics", "simulator", "inference", "rollout"
REPLAY, LEARNER, COACH = "replay", "learner", "coach"
EVALUATION, CHECKPOINT = "evaluation", "checkpoint"
PARTS = (
    *(PHYSICS, SIMULATOR, INFERENCE, ROLLOUT, REPLAY, LEARNER),
    *(COACH, EVALUATION, CHECKPOINT, REST),
)
_EMPTY_CALLS = 20_000

Tell = Callable[[str], None]


class Stopwatch:
    """Gives every moment to exactly one part: the innermost one that is open, else REST."""

    def __init__(self, clock: Clock, cpu_clock: Clock) -> None:
        self._clock, self._cpu_clock = clock, cpu_clock
        self._open = REST
        self._since_s, self._cpu_since_s = clock(), cpu_clock()
        self._forget()

    def _forget(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self.cpu_seconds = dict.fromkeys(PARTS, 0.0)
        self.calls = dict.fromkeys(PARTS, 0)

    def switch(self, part: str) -> str:
        """From now on time is ``part``'s; returns whose it was."""
        now_s, cpu_now_s = self._clock(), self._cpu_clock()
        self.seconds[self._open] += now_s - self._since_s
        self.cpu_seconds[self._open] += cpu_now_s - self._cpu_since_s
        self._since_s, self._cpu_since_s = now_s, cpu_now_s
        before, self._open = self._open, part
        return before

    def watch(self, owner: object, method: str, part: str) -> None:
        """Times ``owner``'s method from now on.

        An evaluation block is one part, whatever it calls.

        Raises:
            AttributeError: there is no such method.
        """
        inner = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._open == EVALUATION:
                return inner(*args, **kwargs)
            self.calls[part] += 1
            before = self.switch(part)
            try:
                return inner(*args, **kwargs)
            finally:
                self.switch(before)

        setattr(owner, method, timed)

    def taken(self) -> tuple[dict[str, float], dict[str, float], dict[str, int]]:
        """Seconds, seconds of the processor and calls since the last time; starts anew."""
        self.switch(self._open)
        out = self.seconds, self.cpu_seconds, self.calls
        self._forget()
        return out


@dataclass(frozen=True)
class Profile:
    """What was measured, from the first gradient step on.

    ``seconds`` by part adds up to all the time that passed, ``cpu_seconds`` to what this process
    had of the processor; ``timers_s`` is the timers' own part of that, estimated. ``block_s`` is
    the mean length of the evaluation ``blocks``; without any, of one that was played afterwards.
    """

    seconds: dict[str, float]
    cpu_seconds: dict[str, float]
    calls: dict[str, int]
    timers_s: float
    env_steps: int
    episodes: int
    gradient_steps: int
    blocks: int
    block_s: float

    @property
    def wall_s(self) -> float:
        return sum(self.seconds.values())

    @property
    def cpu_s(self) -> float:
        return sum(self.cpu_seconds.values())

    @property
    def steps_per_s(self) -> float:
        return self.env_steps / self.wall_s

    def share(self, part: str) -> float:
        return self.seconds[part] / self.wall_s

    def step_us(self, part: str) -> float:
        """Microseconds of the processor per environment step."""
        return 1e6 * self.cpu_seconds[part] / self.env_steps

    def evaluation_share(self, interval_steps: int) -> float:
        """Of a run with a block every ``interval_steps``, however many were measured."""
        others_s = (self.wall_s - self.seconds[EVALUATION]) / self.env_steps
        block_s = self.block_s / interval_steps
        return block_s / (block_s + others_s)


class _Enough(Exception):
    """Ends the run when enough was measured."""


@dataclass
class _Meter:
    """Opens a session's seams, waits until it learns, and ends the run ``seconds`` later."""

    seconds: float
    clock: Clock
    cpu_clock: Clock
    tell: Tell
    started_s: float | None = None

    def __post_init__(self) -> None:
        self.stopwatch = Stopwatch(self.clock, self.cpu_clock)
        self._opened_s = self.clock()

    def open(self, session: TrainSession) -> None:
        self._session = session
        env = session.env
        watch = self.stopwatch.watch
        if isinstance(env, Env):
            for method in ("advance", "place", "take_out"):
                watch(env.world, method, PHYSICS)
        for owner, part, methods in (
            (env, SIMULATOR, ("step", "reset")),
            (session.policy, INFERENCE, ("forward", "set_weights")),
            (session.rollout, ROLLOUT, ("step",)),
            (session.replay, REPLAY, ("add", "sample")),
            (session.learner, LEARNER, ("update",)),
            (session.coach, COACH, ("plan", "finish", "record_block")),
            (session, EVALUATION, ("test",)),
        ):
            for method in methods:
                watch(owner, method, part)
        self._watch_loop(session)

    def _watch_loop(self, session: TrainSession) -> None:
        inner = session.advance

        def advance() -> None:
            self.stopwatch.switch(REST)  # a checkpoint ends here
            self._look()
            inner()

        session.advance = advance  # type: ignore[method-assign]

    def _look(self) -> None:
        now_s = self.clock()
        if self.started_s is not None:
            if now_s - self.started_s >= self.seconds:
                raise _Enough
        elif self._session.learner.updates or now_s - self._opened_s >= self.seconds:
            self._start()

    def _start(self) -> None:
        done = self._session.counters
        self._before = (done.env_steps, done.episodes, self._session.learner.updates)
        self.stopwatch.taken()
        self.started_s = self.clock()

    def on_report(self, report: ProgressReport) -> None:
        """A checkpoint is not a method of the session; the trainer says when it begins."""
        if report.phase == "checkpoint":
            self.stopwatch.calls[CHECKPOINT] += 1
            self.stopwatch.switch(CHECKPOINT)
        waiting = self.started_s is None
        doing = "waiting for the first gradient step" if waiting else "measuring"
        self.tell(f"{report.steps:,} steps, {doing}")

    def profile(self) -> Profile:
        """Of what was measured until now."""
        done, learner = self._session.counters, self._session.learner
        now = (done.env_steps, done.episodes, learner.updates)
        if self.started_s is None or now[0] == self._before[0]:
            raise UserError(
                f"the run ended after {now[0]} steps, before there was anything to measure: "
                "give it more total_steps"
            )
        steps, episodes, updates = (a - b for a, b in zip(now, self._before, strict=True))
        seconds, cpu_seconds, calls = self.stopwatch.taken()
        blocks = calls[EVALUATION]
        return Profile(
            seconds=seconds,
            cpu_seconds=cpu_seconds,
            calls=calls,
            timers_s=sum(calls.values()) * _timer_s(self.clock, self.cpu_clock),
            env_steps=steps,
            episodes=episodes,
            gradient_steps=updates,
            blocks=blocks,
            block_s=seconds[EVALUATION] / blocks if blocks else self._extra_block_s(),
        )

    def _extra_block_s(self) -> float:
        begin_s = self.clock()
        self._session.test()
        return self.clock() - begin_s


def _timer_s(clock: Clock, cpu_clock: Clock) -> float:
    """Processor time of timing a call: that of a method which does nothing."""

    class Nothing:
        def call(self) -> None: ...

    plain, watched, stopwatch = Nothing(), Nothing(), Stopwatch(clock, cpu_clock)
    stopwatch.watch(watched, "call", SIMULATOR)
    spent_s = []
    for nothing in (plain, watched):
        begin_s = cpu_clock()
        for _ in range(_EMPTY_CALLS):
            nothing.call()
        spent_s.append(cpu_clock() - begin_s)
    return max(0.0, spent_s[1] - spent_s[0]) / _EMPTY_CALLS


def profile(
    config: TrainConfig,
    seconds: float,
    tell: Tell = lambda text: None,
    out_dir: Path | None = None,
    clock: Clock = time.perf_counter,
    cpu_clock: Clock = time.process_time,
) -> Profile:
    """Trains from the start, and measures for ``seconds`` from the first gradient step on.

    Where none comes within ``seconds``, it measures all the same. The run is the one that ``train``
    would make, up to where it is ended.

    Args:
        tell: a line about where the run stands, a few times per second.
        out_dir: as for ``train``; None: a folder that is removed afterwards.

    Raises:
        UserError: as ``train``, or the run ended before anything could be measured.
    """
    meter = _Meter(seconds, clock, cpu_clock, tell)
    with tempfile.TemporaryDirectory(prefix="crash_coach_profile_") as folder:
        run = out_dir or Path(folder) / "run"
        with suppress(_Enough):
            train(config, run, progress=meter.on_report, clock=clock, opened=meter.open)
        return meter.profile()
