"""What a fault scenario expects of a team, judged on pairs of episodes.

A pair is one episode played twice with the same seed: with the faults, and without. An expectation
is a schema for the YAML file and ``judge`` in one class; ``Expectation`` lists the kinds.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Status = Literal["passed", "failed", "error"]


@dataclass(frozen=True)
class Outcome:
    """How an episode ended."""

    success: bool
    episode_return: float  # undiscounted
    steps: int


@dataclass(frozen=True)
class DueFault:
    """A fault whose time came: its start step was reached, or its trigger fired.

    ``met_dead``: it only ever met commands of a robot that could do nothing any more, and so took
    no effect.
    """

    entry: int
    robot: str
    took_effect: bool
    met_dead: bool = False


@dataclass(frozen=True)
class Pair:
    """One episode with the faults and without, from the same seed."""

    episode: int
    crash_free: Outcome
    faulted: Outcome
    crashed: int  # robots on which a fault was in force
    due: tuple[DueFault, ...]


@dataclass(frozen=True)
class Trials:
    """All pairs of a run, at least one, of a scenario with so many fault entries."""

    entries: int
    pairs: tuple[Pair, ...]


@dataclass(frozen=True)
class Finding:
    """``measured`` None: there was nothing to measure, and ``note`` says why.

    ``counts``: (hits, trials) where ``measured`` is a rate of independent trials.
    """

    status: Status
    measured: float | None
    counts: tuple[int, int] | None = None
    note: str = ""


class ExpectationKind(BaseModel):
    """What every expectation has."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @abstractmethod
    def wanted(self) -> str:
        """One line, such as 'success rate at least 90 %'."""

    @abstractmethod
    def judge(self, trials: Trials) -> Finding:
        """Holds the pairs against it."""


class SuccessRate(ExpectationKind):
    """Share of the faulted episodes that succeed."""

    at_least: float = Field(ge=0, le=1, description="Share of the episodes.")
    crashed: int | None = Field(
        default=None,
        ge=0,
        description="Only episodes with faults in force on exactly this many robots; "
        "null: all episodes.",
    )

    def wanted(self) -> str:
        which = "" if self.crashed is None else f" with {self.crashed} crashed"
        return f"success rate{which} at least {_percent(self.at_least)}"

    def judge(self, trials: Trials) -> Finding:
        counted = [p for p in trials.pairs if self.crashed is None or p.crashed == self.crashed]
        if not counted:
            seen = ", ".join(str(k) for k in sorted({p.crashed for p in trials.pairs}))
            note = f"no episode had {self.crashed} crashed robots (there were episodes with {seen})"
            return Finding("error", None, note=note)
        return _rate(sum(p.faulted.success for p in counted), len(counted), self.at_least)


class ReturnRetained(ExpectationKind):
    """Mean return with the faults, as a share of the crash-free mean."""

    at_least: float = Field(ge=0, le=10, description="Share of the crash-free mean return.")

    def wanted(self) -> str:
        return f"at least {_percent(self.at_least)} of the crash-free return retained"

    def judge(self, trials: Trials) -> Finding:
        free = _mean([p.crash_free.episode_return for p in trials.pairs])
        if free <= 0:
            note = f"the crash-free mean return is {free:.3g}, no share of it means anything: "
            return Finding("error", None, note=note + "expect return_drop instead")
        retained = _mean([p.faulted.episode_return for p in trials.pairs]) / free
        return Finding(_status(retained >= self.at_least), retained)


class ReturnDrop(ExpectationKind):
    """Crash-free mean return minus the mean return with the faults."""

    at_most: float = Field(
        description="In units of the return; negative: the faults have to raise it."
    )

    def wanted(self) -> str:
        return f"mean return drops by at most {self.at_most:g}"

    def judge(self, trials: Trials) -> Finding:
        drop = _mean([p.crash_free.episode_return - p.faulted.episode_return for p in trials.pairs])
        return Finding(_status(drop <= self.at_most), drop)


class Recovered(ExpectationKind):
    """Of the pairs whose crash-free episode succeeds: the faulted one succeeds hardly later."""

    within_steps: int = Field(
        ge=0, description="Control steps by which the faulted episode may be longer."
    )
    at_least: float = Field(ge=0, le=1, description="Share of those pairs.")

    def wanted(self) -> str:
        return f"at least {_percent(self.at_least)} succeed within {self.within_steps} more steps"

    def judge(self, trials: Trials) -> Finding:
        counted = [p for p in trials.pairs if p.crash_free.success]
        if not counted:
            return Finding("error", None, note="no episode succeeds without the faults either")
        hits = sum(
            p.faulted.success and p.faulted.steps <= p.crash_free.steps + self.within_steps
            for p in counted
        )
        return _rate(hits, len(counted), self.at_least)


class Effects(ExpectationKind):
    """Of all faults whose time came: those that took effect. Every entry's time has to come.
    A fault on commands that only met a robot that was out of action already took none."""

    at_least: float = Field(default=1.0, ge=0, le=1, description="Share of the faults.")

    def wanted(self) -> str:
        return (
            f"every entry comes due, at least {_percent(self.at_least)} of the faults take effect"
        )

    def judge(self, trials: Trials) -> Finding:
        due = [fault for pair in trials.pairs for fault in pair.due]
        never = sorted(set(range(trials.entries)) - {fault.entry for fault in due})
        notes = [f"never due: entry {', '.join(map(str, never))} of faults"] if never else []
        if dead := sum(fault.met_dead for fault in due):
            notes.append(f"{dead} only met a robot that was out of action already")
        note = "; ".join(notes)
        if not due:
            return Finding("failed", None, note=note)
        hits = sum(fault.took_effect for fault in due)
        share = hits / len(due)
        return Finding(_status(share >= self.at_least and not never), share, (hits, len(due)), note)


class Expectation(BaseModel):
    """One entry of ``expect``: exactly one kind."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    success_rate: SuccessRate | None = None
    return_retained: ReturnRetained | None = None
    return_drop: ReturnDrop | None = None
    recovered: Recovered | None = None
    effects: Effects | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        if len(self._given()) != 1:
            kinds = ", ".join(type(self).model_fields)
            given = ", ".join(self._given()) or "none"
            raise ValueError(f"an expectation is exactly one of: {kinds}; given: {given}")
        return self

    def _given(self) -> list[str]:
        return [name for name in type(self).model_fields if getattr(self, name) is not None]

    @property
    def name(self) -> str:
        """The kind's key in the YAML file."""
        return self._given()[0]

    @property
    def kind(self) -> ExpectationKind:
        found = getattr(self, self.name)
        assert isinstance(found, ExpectationKind)
        return found


def _rate(hits: int, trials: int, at_least: float) -> Finding:
    return Finding(_status(hits / trials >= at_least), hits / trials, (hits, trials))


def _status(passed: bool) -> Status:
    return "passed" if passed else "failed"


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _percent(share: float) -> str:
    return f"{100 * share:g} %"
