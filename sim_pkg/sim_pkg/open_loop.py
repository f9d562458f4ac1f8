"""The open-loop control: teams that see only their own names and the time, and a search for them.

What such a team wins needs neither sensing nor coordination (Ellis et al. 2023, SMACv2), so a
trained team's success on that map is no evidence of either. A team is an order of preference over
the actions, of each robot in each stretch of an episode; the search is the cross-entropy method
(Rubinstein 1999) over the Gaussian scores that such orders follow from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BatchEnv, BoolArray, IntArray, stay_action

Float64Array = npt.NDArray[np.float64]

STRETCHES = 20  # of an episode, at most; each robot has one order in each
SPREADS = 1.0, 0.3, 0.3  # at first: of what all share, of each robot's, of each stretch's
LEAST_SPREAD = 0.05
CHOICES = 4  # of the last generation, beside its mean, that are compared once more


@dataclass(frozen=True)
class Search:
    """How long to search: every team of a generation plays the same, fresh episodes.

    ``first_teams``: of the first generation, which spends few of them on each.
    """

    generations: int = 20
    teams: int = 24
    episodes: int = 8
    first_teams: int = 1536
    first_episodes: int = 2
    elite: int = 6
    compared_on: int = 32  # episodes, to choose among the last generation's best

    @property
    def arenas(self) -> int:
        """As many as a generation can use at once."""
        return self.teams * self.episodes


@dataclass(frozen=True)
class OpenLoopTeam:
    """``scores``: (n, S, A), the higher the sooner; ``masked``: whether it knows what it can do.

    A masked team takes the action that it prefers among the available ones; another team takes
    the one that it prefers, and stays where that is not available.
    """

    scores: Float64Array
    masked: bool

    def act(self, step: int, available: BoolArray, env: BatchEnv) -> IntArray:
        """(B, n) actions in control step ``step`` of all arenas; available: (B, n, A)."""
        return _act(self.scores[None], self.masked, step, available, env)


@dataclass(frozen=True)
class Score:
    """What a team achieved."""

    wins: int
    episodes: int
    return_mean: float
    steps_mean: float


def play(team: OpenLoopTeam, env: BatchEnv, seed: int, episodes: range) -> Score:
    """Plays ``episodes`` of ``seed`` in ``env``, which nothing else uses."""
    wins, returns, steps = 0, 0.0, 0
    numbers = np.asarray(episodes, dtype=np.int64)
    for first in range(0, len(numbers), env.n_arenas):
        some = numbers[first : first + env.n_arenas]
        won, gained, lasted = _run(team.scores[None], team.masked, env, seed, some)
        wins, returns, steps = wins + int(won.sum()), returns + gained.sum(), steps + lasted.sum()
    count = len(numbers)
    return Score(wins, count, float(returns) / count, float(steps) / count)


def search(env: BatchEnv, masked: bool, seed: int, how: Search | None = None) -> OpenLoopTeam:
    """The best team found, by wins and then by return; the same arguments, the same team.

    Args:
        env: nothing else uses it; with ``how.arenas`` arenas it is fastest.
        seed: of the episodes that are searched on, and of the draws.
    """
    how = how or Search()
    rng = np.random.default_rng(seed)
    shape = (env.spec.n_robots, min(STRETCHES, env.spec.episode_limit), env.spec.n_actions)
    # A team's scores are the sum of what all robots share, of each robot's own, and of each
    # stretch's: an order that holds for all and throughout is then found as fast as it can be.
    shapes = (1, 1, shape[2]), (shape[0], 1, shape[2]), shape
    means = [np.zeros(each) for each in shapes]
    spreads = [np.full(each, s) for each, s in zip(shapes, SPREADS, strict=True)]
    scores, fresh = np.zeros((0, *shape)), range(0)
    for generation in range(how.generations):
        teams, episodes = how.teams, how.episodes
        if generation == 0:
            teams, episodes = how.first_teams, how.first_episodes
        fresh = range(fresh.stop, fresh.stop + episodes)
        parts = [
            mean + spread * rng.standard_normal((teams, *mean.shape))
            for mean, spread in zip(means, spreads, strict=True)
        ]
        scores = parts[0] + parts[1] + parts[2]
        elite = _ranked(scores, masked, env, seed, fresh)[: how.elite]
        means = [part[elite].mean(axis=0) for part in parts]
        spreads = [np.maximum(LEAST_SPREAD, part[elite].std(axis=0)) for part in parts]
        scores = scores[elite]
    choices = np.concatenate([sum(means, np.zeros(shape))[None], scores[:CHOICES]])
    fresh = range(fresh.stop, fresh.stop + how.compared_on)
    best = _ranked(choices, masked, env, seed, fresh)[0]
    return OpenLoopTeam(choices[best], masked)


def _ranked(
    scores: Float64Array, masked: bool, env: BatchEnv, seed: int, episodes: range
) -> npt.NDArray[np.intp]:
    """Teams (C, n, S, A), the best first."""
    wins, returns = np.zeros(len(scores)), np.zeros(len(scores))
    pairs = np.stack(np.meshgrid(np.arange(len(scores)), episodes, indexing="ij"), axis=-1)
    pairs = pairs.reshape(-1, 2)
    for first in range(0, len(pairs), env.n_arenas):
        teams, numbers = pairs[first : first + env.n_arenas].T
        won, gained, _ = _run(scores[teams], masked, env, seed, numbers)
        np.add.at(wins, teams, won)
        np.add.at(returns, teams, gained)
    return np.lexsort((-returns, -wins))


def _run(
    scores: Float64Array, masked: bool, env: BatchEnv, seed: int, episodes: npt.NDArray[np.int64]
) -> tuple[BoolArray, Float64Array, npt.NDArray[np.int64]]:
    """(E,) success, return and length of each episode; scores: (E, n, S, A), or (1, n, S, A)."""
    count = len(episodes)
    arenas = np.arange(count)
    every = np.zeros((env.n_arenas, *scores.shape[1:]))
    every[:count] = scores
    env.reset(arenas, seed, episodes)
    won = np.zeros(env.n_arenas, dtype=np.bool_)
    gained = np.zeros(env.n_arenas)
    lasted = np.zeros(env.n_arenas, dtype=np.int64)
    running = arenas >= 0
    running = np.concatenate([running, np.zeros(env.n_arenas - count, dtype=np.bool_)])
    step = 0
    while running.any():
        result = env.step(_act(every, masked, step, env.available, env))
        gained += result.reward
        lasted += running
        ended = running & (result.terminated | result.truncated)
        won |= ended & result.success
        running &= ~ended
        step += 1
    return won[:count], gained[:count], lasted[:count]


def _act(
    scores: Float64Array, masked: bool, step: int, available: BoolArray, env: BatchEnv
) -> IntArray:
    """(B, n) actions of teams (B, n, S, A), or of one team for all."""
    stretches = scores.shape[2]
    stretch = min(stretches - 1, step * stretches // env.spec.episode_limit)
    liked = np.broadcast_to(scores[:, :, stretch], available.shape)
    if masked:
        best: IntArray = np.argmax(np.where(available, liked, -np.inf), axis=-1).astype(np.int32)
        return best
    wanted = np.argmax(liked, axis=-1).astype(np.int32)
    can = np.take_along_axis(available, wanted[..., None], axis=-1)[..., 0]
    actions: IntArray = np.where(can, wanted, stay_action(available, env.spec.stay_actions))
    return actions
