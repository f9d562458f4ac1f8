"""An episode as what can be drawn of it, step by step; the render modules draw it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, FloatArray, IntArray
from sim_pkg.env import Env
from sim_pkg.scenarios.base import Actor, Scene, Side

__all__ = ["Actor", "Frames", "Recorder", "Side", "actors", "vitals", "walled_m"]


@dataclass(frozen=True)
class Frames:
    """One episode of T steps: what was where before the first step and after each one.

    The first n of the d actors are the robots, in their order.
    """

    scenario: str
    seed: int
    episode: int
    dt_s: float
    scene: Scene
    walled_m: tuple[float, float, float, float]  # x1, y1, x2, y2 of the part between the walls
    actors: tuple[Actor, ...]
    positions_m: FloatArray  # (T+1, d, 2)
    angles_rad: FloatArray  # (T+1, d)
    health: FloatArray  # (T+1, d) share of the full health, 0: dead; 1 without such a thing
    shield: FloatArray  # (T+1, d) share of the full shield
    damage: FloatArray  # (T, d, d) what i took from j in a step
    sites_done: BoolArray  # (T+1, m)
    intents: IntArray  # (T, n) actions that the policies wanted; -1 where that is not known
    actions: IntArray  # (T, n) actions executed
    faults: npt.NDArray[np.uint8]  # (T, n) code of the fault in force, 0: none
    returns: npt.NDArray[np.float64]  # (T+1,) sum of the rewards so far
    success: bool
    trajectory_hash: str

    @property
    def steps(self) -> int:
        return len(self.faults)

    @property
    def n_robots(self) -> int:
        return int(self.faults.shape[1])

    @property
    def crashed(self) -> BoolArray:
        """(T, n) robots that a fault was in force on."""
        crashed: BoolArray = self.faults != 0
        return crashed

    @property
    def robots(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(actor.name for actor in self.actors[: self.n_robots])

    @property
    def alive(self) -> BoolArray:
        """(T+1, d)"""
        alive: BoolArray = self.health > 0
        return alive

    @property
    def hits(self) -> BoolArray:
        """(T, d) which actors were hit in a step."""
        hits: BoolArray = np.any(self.damage > 0, axis=1)
        return hits

    @property
    def faulted(self) -> tuple[int, ...]:
        """Robots that were crashed in any step."""
        return tuple(np.flatnonzero(self.crashed.any(axis=0)).tolist())

    def indexes(self, side: Side) -> list[int]:
        return [i for i, actor in enumerate(self.actors) if actor.side is side]


class Recorder:
    """Gathers the Frames of one arena's running episode; to be made right after its reset."""

    def __init__(self, env: Env, arena: int, seed: int, episode: int) -> None:
        self._env = env
        self._arena = arena
        self._key = (seed, episode)
        self._bodies: list[tuple[FloatArray, FloatArray]] = []
        self._vitals: list[tuple[FloatArray, FloatArray]] = []
        self._sites_done: list[BoolArray] = []
        self._damage: list[FloatArray] = []
        self._intents: list[IntArray] = []
        self._actions: list[IntArray] = []
        self._faults: list[npt.NDArray[np.uint8]] = []
        self._returns = [0.0]
        self._look()

    def step(
        self,
        intents: IntArray,
        actions: IntArray,
        faults: npt.NDArray[np.uint8],
        reward: float,
    ) -> None:
        """After a control step. (n,) wanted and executed actions, and codes of faults in force."""
        self._intents.append(intents.astype(np.int32))
        self._actions.append(actions.astype(np.int32))
        self._faults.append(faults.astype(np.uint8))
        self._damage.append(self._env.hits[self._arena].copy())
        self._returns.append(self._returns[-1] + reward)
        self._look()

    def so_far(self) -> Frames:
        """What was gathered of an episode under way; before its first step, a step at rest."""
        if self._faults:
            return self.finish(False, "")
        n = self._env.spec.n_robots
        still = Recorder(self._env, self._arena, *self._key)
        unknown = np.full(n, -1)
        still.step(unknown, unknown, np.zeros(n, dtype=np.uint8), 0.0)
        return replace(still.finish(False, ""), damage=np.zeros_like(still._all_damage()))

    def finish(self, success: bool, trajectory_hash: str) -> Frames:
        """What was gathered, when the episode has ended."""
        env, (seed, episode) = self._env, self._key
        return Frames(
            scenario=env.spec.scenario,
            seed=seed,
            episode=episode,
            dt_s=env.spec.dt_s,
            scene=env.scene,
            walled_m=walled_m(env),
            actors=actors(env),
            positions_m=np.stack([positions for positions, _ in self._bodies]),
            angles_rad=np.stack([angles for _, angles in self._bodies]),
            health=np.stack([health for health, _ in self._vitals]),
            shield=np.stack([shield for _, shield in self._vitals]),
            damage=self._all_damage(),
            sites_done=np.stack(self._sites_done),
            intents=np.stack(self._intents),
            actions=np.stack(self._actions),
            faults=np.stack(self._faults),
            returns=np.array(self._returns),
            success=success,
            trajectory_hash=trajectory_hash,
        )

    def _all_damage(self) -> FloatArray:
        """(T, d, d); only discs take and do damage, and they come first."""
        among_discs = np.stack(self._damage)
        more = self._env.world.bodies.shape[1] - among_discs.shape[1]
        return np.pad(among_discs, ((0, 0), (0, more), (0, more)))

    def _look(self) -> None:
        env, arena = self._env, self._arena
        bodies, turns = env.world.bodies[arena], env.world.turns[arena]
        self._bodies.append((bodies[:, :2].astype(np.float32), turns[:, 0].astype(np.float32)))
        self._vitals.append(vitals(env, arena))
        self._sites_done.append(env.sites_done[arena].copy())


def walled_m(env: Env) -> tuple[float, float, float, float]:
    """x1, y1, x2, y2 of the part of the arena between its walls."""
    return env.scene.walled_m or (0.0, 0.0, *env.scene.arena_m)


def actors(env: Env) -> tuple[Actor, ...]:
    """Who and what takes part in the scenario, in the order of the world's bodies."""
    if env.scene.actors:
        return env.scene.actors
    robots = tuple(
        Actor(name, "robot", Side.ROBOTS, radius)
        for name, radius in zip(env.spec.robots, env.scene.radii_m, strict=True)
    )
    boxes = tuple(
        Actor(f"box_{k + 1}", "box", Side.THINGS, 0.0, size_m)
        for k, size_m in enumerate(env.scene.boxes_m)
    )
    return robots + boxes


def vitals(env: Env, arena: int) -> tuple[FloatArray, FloatArray]:
    """(d,) health and (d,) shield of the scenario's actors, as shares of the full ones."""
    if env.scene.vitals is not None:
        return env.scene.vitals(env.state[arena])
    d = env.world.bodies.shape[1]
    return np.ones(d, dtype=np.float32), np.zeros(d, dtype=np.float32)
