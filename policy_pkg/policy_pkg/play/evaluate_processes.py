"""An evaluation divided among processes: the same episodes, so the same results, bit for bit."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import NamedTuple

from crash_coach_common.contract import UserError
from crash_coach_common.spawned import hear, start_deaf
from policy_pkg.checkpoint import PolicyBundle
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation, Scripted, evaluate
from sim_pkg.env import ScenarioLike


class _Task(NamedTuple):
    """What every process plays, of its own episodes."""

    team: PolicyBundle | Scripted
    scenario: ScenarioLike
    conditions: Sequence[Condition]
    seed: int

    def play(self, episodes: int | range) -> list[Evaluation]:
        return [
            evaluate(self.team, self.scenario, condition, episodes, self.seed)
            for condition in self.conditions
        ]


def evaluate_on(
    processes: int,
    team: PolicyBundle | Scripted,
    scenario: ScenarioLike,
    conditions: Sequence[Condition],
    episodes: int,
    seed: int,
) -> list[Evaluation]:
    """``evaluate`` under each condition; each of the processes plays its part of the episodes.

    Raises:
        UserError: as ``evaluate``, or a process died.
    """
    task = _Task(team, scenario, conditions, seed)
    count = max(1, min(processes, episodes))
    if count == 1:
        return task.play(episodes)
    bounds = [episodes * i // count for i in range(count + 1)]
    parts = _play_apart(task, [range(*pair) for pair in pairwise(bounds)])
    return [_joined(of_one) for of_one in zip(*parts, strict=True)]


def _joined(parts: Sequence[Evaluation]) -> Evaluation:
    return replace(parts[0], episodes=tuple(e for part in parts for e in part.episodes))


def _play_apart(task: _Task, shares: Sequence[range]) -> list[list[Evaluation]]:
    """Each share in a process of its own; in their order."""
    context = get_context("spawn")
    started: list[tuple[SpawnProcess, Connection]] = []
    try:
        for _ in shares:
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs,), daemon=True)
            start_deaf(process)
            theirs.close()  # so that the pipe ends with the process
            started.append((process, ours))
        # Not as arguments of the processes: where one died as it began, they would wait for ever.
        for (process, ours), share in zip(started, shares, strict=True):
            with _told_of_death(process):
                ours.send((task, share))
        return [_result(*each) for each in started]
    finally:
        for process, _ in started:
            process.terminate()
            process.join()


def _result(process: SpawnProcess, ours: Connection) -> list[Evaluation]:
    with _told_of_death(process):
        result: list[Evaluation] | UserError = ours.recv()
    if isinstance(result, UserError):
        raise result
    return result


@contextmanager
def _told_of_death(process: SpawnProcess) -> Iterator[None]:
    try:
        yield
    except (EOFError, ConnectionError):
        process.join()
        raise UserError(f"a process of the evaluation died, exit code {process.exitcode}") from None


def _work(connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    hear()
    result: list[Evaluation] | UserError
    with suppress(EOFError, ConnectionError):  # nobody waits for it any more
        task, share = connection.recv()
        try:
            result = task.play(share)
        except UserError as error:
            result = error
        connection.send(result)
