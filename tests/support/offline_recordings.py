"""Recordings for the tests of offline learning: rollouts in this process, and random ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from reference_learner import random_episode

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.team import TeamSpec
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.play.rollout import Rollout
from policy_pkg.policy import RecurrentPolicy
from sim_pkg.env import make_env

SIZES = Sizes(
    n_robots=3, n_actions=4, obs_size=5, state_size=6, episode_limit=7, stay_actions=(2, 0)
)


@dataclass(frozen=True)
class Recording:
    """What a bag's episode says."""

    robots: tuple[str, ...]
    episode: Episode
    intents: npt.NDArray[np.int32]
    success: bool
    seed: int
    number: int
    scenario: str = ""


def recording(episode: Episode, number: int, seed: int = 0) -> Recording:
    """Crashed robots wanted something else than what they did."""
    actions = episode.available.shape[2]
    intents = np.where(episode.faults == 0, episode.actions, (episode.actions + 1) % actions)
    robots = tuple(f"robot_{i + 1}" for i in range(episode.obs.shape[1]))
    return Recording(robots, episode, intents.astype(np.int32), number % 2 == 0, seed, number)


def random_recordings(
    count: int, seed: int = 0, crash_rate: float = 0.3, sizes: Sizes = SIZES
) -> list[Recording]:
    rng = np.random.default_rng(seed)
    return [
        recording(
            random_episode(
                sizes,
                rng,
                int(rng.integers(1, sizes.episode_limit + 1)),
                bool(rng.integers(2)),
                crash_rate,
            ),
            number,
            seed,
        )
        for number in range(count)
    ]


def with_crashes(episode: Episode, robots: list[int]) -> Episode:
    """The same episode, these robots faulted in its first step."""
    faults = np.zeros_like(episode.faults)
    faults[0, robots] = 1
    return replace(episode, faults=faults)


def buttons_recordings(count: int, seed: int = 5) -> list[Recording]:
    """A random team's episodes of ``buttons``, half of the robots crashed."""
    env = make_env("buttons", 4)
    spec = env.spec
    weights = Learner(LearnerConfig(hidden=8), Sizes.of(spec), seed=1).agent_weights()
    policy = RecurrentPolicy(weights, spec.n_robots, spec.n_actions)
    crash = CoachConfig(strategy="fixed", crash_rate=0.5, resample=False)
    plan = Coach(crash, TeamSpec.of(spec), seed).plan
    rollout = Rollout(env, policy, plan, seed, np.random.default_rng(2))
    found: list[Recording] = []
    while len(found) < count:
        for finished in rollout.step(1.0):
            arrays = {k: v.copy() for k, v in vars(finished.episode).items() if k != "terminated"}
            episode = replace(finished.episode, **arrays)
            one = recording(episode, finished.plan.episode, seed)
            found.append(replace(one, success=finished.success))
    return found[:count]
