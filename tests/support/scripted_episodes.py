"""Episodes of scripted teams, with muted robots, for the tests of the scenarios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, stay_action
from sim_pkg.env import Env, make_env
from sim_pkg.scripted import make_scripted
from sim_pkg.trajectory import TrajectoryHash

SEED = 1


@dataclass(frozen=True)
class Outcome:
    """Of E episodes, in order."""

    success: BoolArray
    steps: npt.NDArray[np.intp]
    returns: npt.NDArray[np.float64]
    hashes: list[str]


def play(
    scenario: str, policy: str, episodes: int, muted: tuple[int, ...] = (), n_arenas: int = 64
) -> Outcome:
    """``episodes`` episodes, ``n_arenas`` at a time."""
    env = make_env(scenario, n_arenas)
    team = make_scripted(policy, env)
    actions = np.zeros((n_arenas, env.spec.n_robots), dtype=np.int32)
    parts = []
    for first in range(0, episodes, n_arenas):
        numbers = np.arange(first, min(first + n_arenas, episodes))
        arenas = np.arange(len(numbers))
        env.reset(arenas, SEED, numbers)
        team.begin(arenas, SEED, numbers)
        parts.append(_run(env, team, actions, numbers, muted))
    return Outcome(
        np.concatenate([p.success for p in parts]),
        np.concatenate([p.steps for p in parts]),
        np.concatenate([p.returns for p in parts]),
        [digest for p in parts for digest in p.hashes],
    )


def _run(env: Env, team, actions, numbers, muted: tuple[int, ...]) -> Outcome:  # type: ignore[no-untyped-def]
    count = len(numbers)
    digests = [TrajectoryHash(SEED, int(e)) for e in numbers]
    success, steps = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.intp)
    returns = np.zeros(count)
    while env.running.any():
        running = np.flatnonzero(env.running)
        team.act(env.obs, env.available, actions)
        for robot in muted:
            actions[:, robot] = stay_action(env.available[:, robot], env.spec.stay_actions)
        for b in running:
            digests[b].observe(env.obs[b], env.state[b])
        r = env.step(actions)
        for b in running:
            flags = bool(r.terminated[b]), bool(r.truncated[b]), bool(r.success[b])
            digests[b].act(actions[b], float(r.reward[b]), *flags)
        success |= r.success[:count]
        returns += r.reward[:count]
        steps[running] += 1
    return Outcome(success, steps, returns, [d.hexdigest() for d in digests])
