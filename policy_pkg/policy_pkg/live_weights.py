"""Weights that come while a team plays: which of them count, and from which episode on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load

from crash_coach_common.contract import UserError
from policy_pkg.act import Exploration, best_and_worst
from policy_pkg.agent import Agent
from policy_pkg.policy import RecurrentPolicy, WeightArrays, check_weights

Stamp = TypeVar("Stamp")


@dataclass(frozen=True)
class Weights:
    """One version of a team's agent net, and how to explore with it.

    ``from_episode``: the first episode that it is meant for.
    """

    version: int
    from_episode: int
    exploration: Exploration
    robots: tuple[str, ...]
    obs_size: int
    n_actions: int
    arrays: WeightArrays

    @classmethod
    def read(
        cls,
        version: int,
        from_episode: int,
        epsilon: float,
        seed: int,
        robots: tuple[str, ...],
        obs_size: int,
        n_actions: int,
        agent: bytes,
    ) -> Self:
        """From the fields of a PolicyWeights message; ``agent`` is in safetensors' format.

        Raises:
            UserError: damaged, or sizes that do not fit together.
        """
        if not 0 <= epsilon <= 1:
            raise UserError(f"weights {version}: epsilon {epsilon} is not in [0, 1]")
        if not robots:
            raise UserError(f"weights {version} name no robots")
        try:
            arrays: WeightArrays = load(agent)
            sizes = check_weights(arrays, len(robots), n_actions)
        except (SafetensorError, ValueError, KeyError) as error:
            raise UserError(f"weights {version} of {len(agent)} bytes: {error}") from error
        if sizes.obs != obs_size or any(a.dtype != np.float32 for a in arrays.values()):
            raise UserError(
                f"weights {version} are for {sizes.obs} observation features, not {obs_size}, or "
                "not float32"
            )
        exploration = Exploration(epsilon, seed, len(robots))
        return cls(version, from_episode, exploration, robots, obs_size, n_actions, arrays)


class LiveAgent(Generic[Stamp]):
    """An Agent whose weights change between episodes.

    Args:
        first: the team, its sizes, and the weights to begin with, whatever episode they are for.
        robots: those of the team that it acts for; empty: all.

    Raises:
        UserError: a robot that is not of the team.
    """

    def __init__(self, first: Weights, robots: tuple[str, ...]) -> None:
        self._first = first
        self._policy = RecurrentPolicy(first.arrays, len(first.robots), first.n_actions)
        self.agent: Agent[Stamp] = Agent(
            self._policy,
            first.robots,
            robots or first.robots,
            first.obs_size,
            first.n_actions,
            best_and_worst,
        )
        self.agent.exploration = first.exploration
        self._held: list[Weights] = []  # for later episodes, in the order of their arrival

    def offer(self, weights: Weights) -> None:
        """Keeps weights for the episodes that they are meant for.

        Raises:
            UserError: they are another team's, or of other sizes.
        """
        for what, mine, theirs in (
            ("robots", self._first.robots, weights.robots),
            ("observation features", self._first.obs_size, weights.obs_size),
            ("actions", self._first.n_actions, weights.n_actions),
            ("shapes", _shapes(self._first.arrays), _shapes(weights.arrays)),
        ):
            if mine != theirs:
                raise UserError(
                    f"weights {weights.version} have {what} {theirs}, this team has {mine}"
                )
        self._held.append(weights)

    def begin(self, episode: int) -> None:
        """Call with the first observation of ``episode``: takes the newest weights meant for it."""
        due = [place for place, held in enumerate(self._held) if held.from_episode <= episode]
        if not due:
            return
        newest = self._held[due[-1]]
        self._held = self._held[due[-1] + 1 :]
        self._policy.set_weights(newest.arrays)
        self.agent.exploration = newest.exploration


def _shapes(arrays: WeightArrays) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in arrays.items()}
