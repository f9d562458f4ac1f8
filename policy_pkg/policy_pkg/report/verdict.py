"""The verdict on a fault scenario: every episode beside the same episode without the faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from crash_coach_pkg.coach.expectations import DueFault, Expectation, Finding, Outcome, Pair, Trials
from crash_coach_pkg.coach.fault_scenario import FaultScenario, ScenarioPlanner
from crash_coach_pkg.effects import EffectRow
from crash_coach_pkg.plan import CrashPlan, TriggerKind
from policy_pkg.play.evaluate import EpisodeResult, Evaluation
from policy_pkg.statistics import Estimate, wilson


@dataclass(frozen=True)
class Verdict:
    """One expectation, judged.

    ``interval``: Wilson's 95 %, where a rate was measured and more than one episode says so.
    """

    name: str  # the expectation's key in the file
    wanted: str
    finding: Finding
    interval: Estimate | None

    @property
    def passed(self) -> bool:
        return self.finding.status == "passed"


@dataclass(frozen=True)
class EntryEffects:
    """What became of one entry of the file's faults, over all episodes."""

    entry: int
    mode: str
    due: int  # faults whose time came
    took_effect: int  # of those
    robot_steps: int  # commands and observations under it


@dataclass(frozen=True)
class FaultRun:
    """A fault scenario, played and judged."""

    faulted: Evaluation
    crash_free: Evaluation
    trials: Trials
    verdicts: tuple[Verdict, ...]
    entries: tuple[EntryEffects, ...]

    @property
    def passed(self) -> bool:
        """Nothing judged is no pass."""
        return bool(self.verdicts) and all(verdict.passed for verdict in self.verdicts)


def judge_run(
    scenario: FaultScenario,
    planner: ScenarioPlanner,
    faulted: Evaluation,
    crash_free: Evaluation,
    dead_actions: Sequence[int] = (),
) -> FaultRun:
    """Pairs the episodes and judges the scenario's expectations.

    Args:
        faulted: with its effects.
        dead_actions: those of a robot that can do nothing else any more.

    Raises:
        ValueError: the evaluations are not the same episodes of the same seed.
    """
    trials = Trials(
        len(scenario.faults), _pairs(planner, faulted, crash_free, frozenset(dead_actions))
    )
    alike = faulted.alike and crash_free.alike
    verdicts = tuple(_verdict(expectation, trials, alike) for expectation in scenario.expect)
    modes = [fault.crash_mode for fault in scenario.faults]
    entries = tuple(_entry(i, mode, trials, faulted.effects) for i, mode in enumerate(modes))
    return FaultRun(faulted, crash_free, trials, verdicts, entries)


def _pairs(
    planner: ScenarioPlanner,
    faulted: Evaluation,
    crash_free: Evaluation,
    dead_actions: frozenset[int],
) -> tuple[Pair, ...]:
    keys = [[(run.seed, e.episode) for e in run.episodes] for run in (faulted, crash_free)]
    if keys[0] != keys[1]:
        raise ValueError(f"episodes {keys[0]} with faults, {keys[1]} without: they are not paired")
    rows: dict[int, list[EffectRow]] = {e.episode: [] for e in faulted.episodes}
    for row in faulted.effects:
        rows[row.episode].append(row)
    return tuple(
        _pair(
            planner.plan(under.episode),
            *(faulted.robots, under, free, rows[under.episode], dead_actions),
        )
        for under, free in zip(faulted.episodes, crash_free.episodes, strict=True)
    )


def _pair(
    plan: CrashPlan,
    robots: tuple[str, ...],
    faulted: EpisodeResult,
    crash_free: EpisodeResult,
    rows: Sequence[EffectRow],
    dead_actions: frozenset[int],
) -> Pair:
    active = {(row.entry, row.robot) for row in rows if row.kind == "ACTIVE"}
    met = {(row.entry, row.robot) for row in rows if row.kind == "EFFECT"}
    took_effect = {
        (row.entry, row.robot)
        for row in rows
        if row.kind == "EFFECT" and row.intent not in dead_actions
    }
    due = set()
    for fault in plan.faults:
        key = (fault.entry, robots[fault.robot])
        reached = fault.start_step < faulted.steps
        if key in active if fault.trigger.kind != TriggerKind.STEP else reached:
            due.add(key)
    return Pair(
        episode=faulted.episode,
        crash_free=_outcome(crash_free),
        faulted=_outcome(faulted),
        crashed=len(faulted.crashed),
        due=tuple(
            DueFault(*key, key in took_effect, key in met - took_effect) for key in sorted(due)
        ),
    )


def _outcome(result: EpisodeResult) -> Outcome:
    return Outcome(result.success, result.episode_return, result.steps)


def _verdict(expectation: Expectation, trials: Trials, alike: bool) -> Verdict:
    finding = expectation.kind.judge(trials)
    interval = None if alike or finding.counts is None else wilson(*finding.counts)
    return Verdict(expectation.name, expectation.kind.wanted(), finding, interval)


def _entry(entry: int, mode: str, trials: Trials, effects: Sequence[EffectRow]) -> EntryEffects:
    due = [fault for pair in trials.pairs for fault in pair.due if fault.entry == entry]
    steps = sum(row.kind == "EFFECT" and row.entry == entry for row in effects)
    return EntryEffects(entry, mode, len(due), sum(f.took_effect for f in due), steps)
