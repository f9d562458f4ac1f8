"""Recorded episodes played again: the executed actions in the simulator, held against the record.

A recording holds what was observed and done, not where every body was. Seed, episode and executed
actions determine that too, and the trajectory hash tells whether they did.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crash_coach_common.contract import EnvSpec, UserError
from policy_pkg.bags.about import About
from policy_pkg.bags.bag import find_bags
from policy_pkg.bags.dataset import BagReading, RecordedEpisode
from policy_pkg.bags.problems import BagError, Problem
from sim_pkg.env import make_env
from sim_pkg.render.frames import Frames, Recorder
from sim_pkg.session import Session

_SHOWN = 3  # of several recordings


def read_episode(path: Path, number: int | None) -> tuple[RecordedEpisode, About | None]:
    """Episode ``number`` of a recording, None: the first that is complete; and what the recording
    says about itself.

    Raises:
        BagError: not exactly one recording, or no such episode: says which there are.
    """
    bags = find_bags([path])
    if len(bags) > 1:
        names = [bag.name for bag in bags[:_SHOWN]] + ["..."] * (len(bags) > _SHOWN)
        raise BagError(f"{path}: name one of its {len(bags)} recordings: {', '.join(names)}")
    (bag,) = bags
    problems: list[Problem] = []
    reading = BagReading(bag, problems.append)
    complete = []
    for recorded in reading.episodes():
        if number is None or recorded.number == number:
            return recorded, reading.summary.about
        complete.append(recorded.number)
    told = [p.text for p in problems if p.place == f"{bag.name}: episode {number}"]
    why = told or [str(p) for p in problems if number is None][:1]
    which = "complete episode" if number is None else f"complete episode {number}"
    reason = f" ({'; '.join(why)})" if why else ""
    raise BagError(f"{bag.name}: no {which}{reason}; complete: {_ranges(complete)}")


def _ranges(numbers: Sequence[int]) -> str:
    """[0, 1, 2, 5] -> '0..2, 5'"""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1][1:] = [number]
        else:
            runs.append([number])
    return ", ".join("..".join(map(str, run)) for run in runs) or "none"


def play_back(recorded: RecordedEpisode, scenario: str | Path) -> Frames:
    """The recorded episode as what can be drawn; ``crashed`` is that of the recording.

    Raises:
        ConfigError: unknown or wrong scenario.
        UserError: ``scenario`` has another team, or the simulator gives another trajectory.
    """
    env = make_env(scenario, 1)
    _check_team(recorded, env.spec)
    episode = recorded.episode
    session = Session(env, recorded.seed, recorded.number)
    session.begin()
    recorder = Recorder(env, 0, recorded.seed, recorded.number)
    for step in range(episode.length):
        same = np.array_equal(session.state, episode.state[step])
        same = same and np.array_equal(session.available, episode.available[step])
        if not (session.running and same):
            raise _differs(recorded, scenario, step)
        actions, faults = episode.actions[step], episode.faults[step]
        session.advance(actions, (faults != 0).astype(np.uint8))
        recorder.step(recorded.intents[step], actions, faults, session.reward)
    if session.running:
        session.cut()
    if session.trajectory_hash != recorded.trajectory_hash:
        raise _differs(recorded, scenario, episode.length)
    return recorder.finish(session.success, session.trajectory_hash)


def _check_team(recorded: RecordedEpisode, spec: EnvSpec) -> None:
    episode = recorded.episode
    for what, here, there in (
        ("robots", ", ".join(spec.robots), ", ".join(recorded.robots)),
        ("features of an observation", spec.obs_size, episode.obs.shape[2]),
        ("features of the state", spec.state_size, episode.state.shape[1]),
        ("actions", spec.n_actions, episode.available.shape[2]),
    ):
        if here != there:
            raise UserError(
                f"{recorded.bag}: recorded with other {what} ({there}) than scenario "
                f"{spec.scenario!r} has ({here})"
            )


def _differs(recorded: RecordedEpisode, scenario: str | Path, step: int) -> UserError:
    return UserError(
        f"{recorded.bag}: episode {recorded.number} cannot be played again: by step {step} "
        f"scenario '{scenario}' gives another trajectory here than was recorded. It was recorded "
        "with another version of the simulator, or the scenario has changed"
    )
