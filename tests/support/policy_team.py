"""A team that exists only in the tests of the policy nodes: its sizes and what it senses."""

from __future__ import annotations

import numpy as np

from crash_coach_common.contract import EnvSpec
from policy_pkg.act import best_and_worst
from policy_pkg.agent import Agent, Answer, Sensed
from policy_pkg.checkpoint import PolicyBundle

OBS, ACTIONS, ROBOTS = 6, 5, 3
SPEC = EnvSpec(
    scenario="nowhere",
    robots=tuple(f"robot_{i + 1}" for i in range(ROBOTS)),
    action_names=("up", "down", "left", "right", "stay"),
    stay_actions=(4,),
    obs_size=OBS,
    state_size=1,
    episode_limit=20,
    dt_s=0.5,
    bounds=(-1.0, 1.0),
    roles=("robot",) * ROBOTS,
)
ALL = np.ones(ACTIONS, dtype=np.uint8)


def sense(rng: np.random.Generator, step: int, episode: int = 0, last: int = -1) -> Sensed[str]:
    features = rng.uniform(-1, 1, OBS).astype(np.float32)
    available = (rng.random(ACTIONS) < 0.6).astype(np.uint8)
    available[4] = 1
    return Sensed(episode, step, last, features, available, f"{episode}/{step}")


def actions(answers: list[Answer[str]]) -> list[int]:
    return [answer.action for answer in answers]


def make_agent(bundle: PolicyBundle, robots: tuple[str, ...] = SPEC.robots) -> Agent[str]:
    return Agent(bundle.policy, bundle.robots, robots, OBS, ACTIONS, best_and_worst)
