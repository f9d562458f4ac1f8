"""What a scenario supplies; env.py composes it with the physics.

Shapes: B arenas, n robots, d discs (the robots are the first n), O, S and A as in contract.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field

from crash_coach_common.contract import BoolArray, EnvSpec, FloatArray, IntArray, RewardArray
from crash_coach_common.strict_yaml import StrictModel
from sim_pkg.world import Float64Array, World, WorldSpec

# What every kind's configuration may say; beyond these, numbers overflow or memory ends.
EpisodeLimit = Annotated[int, Field(ge=1, le=100_000)]
StepSeconds = Annotated[float, Field(gt=0, le=10)]
MassKg = Annotated[float, Field(ge=1e-3, le=1e6)]
SpeedMps = Annotated[float, Field(gt=0, le=1e3)]


class PhysicsConfig(StrictModel):
    substeps: int = Field(ge=4, le=1000)
    iterations: int = Field(ge=1, le=1000)


class Side(IntEnum):
    """Whose a body is."""

    ROBOTS = 0
    OPPONENTS = 1
    THINGS = 2


@dataclass(frozen=True)
class Actor:
    """One body of an episode; a disc, or where it has a size, a box of (width, height)."""

    name: str
    kind: str
    side: Side
    radius_m: float
    size_m: tuple[float, float] | None = None


Vitals = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""(S,) state -> (d,) health and (d,) shield of the actors, as shares of the full ones."""


@dataclass(frozen=True)
class Scene:
    """What can be drawn of a scenario; metres.

    ``actors`` stand in the order of the World's bodies; empty: the robots, then the boxes.
    """

    arena_m: tuple[float, float]  # width, height; the south-west corner is (0, 0)
    cell_m: float  # side of a grid cell; 0: no grid
    radii_m: tuple[float, ...]  # of each robot
    sites_m: tuple[tuple[float, float], ...]  # centres of the m places that the task is about
    site_name: str = "site"  # what such a place is called
    site_radius_m: float = 0.0  # of a round site; 0: a site is a cell
    boxes_m: tuple[tuple[float, float], ...] = ()  # width, height of each of the World's boxes
    rough_m: tuple[tuple[float, float, float, float], ...] = ()  # x1, y1, x2, y2 of rough floor
    walled_m: tuple[float, float, float, float] | None = None  # the part between walls; None: all
    actors: tuple[Actor, ...] = ()
    vitals: Vitals | None = None  # None: nobody can be hurt


@dataclass(frozen=True)
class Buffers:
    """The environment's arrays, allocated once and filled by the scenario."""

    obs: FloatArray  # (B, n, O)
    state: FloatArray  # (B, S)
    available: BoolArray  # (B, n, A)
    reward: RewardArray  # (B,)
    terminated: BoolArray  # (B,)
    truncated: BoolArray  # (B,)
    success: BoolArray  # (B,)
    sites_done: BoolArray  # (B, m)
    hits: FloatArray  # (B, d, d) what disc i took from disc j in the last step; 0: no hits here

    @classmethod
    def allocate(cls, spec: EnvSpec, n_sites: int, n_discs: int, n_arenas: int) -> Buffers:
        n, b = spec.n_robots, n_arenas
        return cls(
            obs=np.zeros((b, n, spec.obs_size), dtype=np.float32),
            state=np.zeros((b, spec.state_size), dtype=np.float32),
            available=np.ones((b, n, spec.n_actions), dtype=np.bool_),
            reward=np.zeros(b, dtype=np.float64),
            terminated=np.zeros(b, dtype=np.bool_),
            truncated=np.zeros(b, dtype=np.bool_),
            success=np.zeros(b, dtype=np.bool_),
            sites_done=np.zeros((b, n_sites), dtype=np.bool_),
            hits=np.zeros((b, n_discs, n_discs), dtype=np.float32),
        )

    def clear_outcome(self) -> None:
        """Reward 0 and no flag in every arena."""
        for array in (self.reward, self.terminated, self.truncated, self.success):
            array.fill(0)


class Scenario(Protocol):
    """The rules of one task over B arenas.

    The hooks read the physics from ``World.bodies`` and write to ``World.commands``.
    """

    spec: EnvSpec
    world: WorldSpec
    scene: Scene

    @property
    def config(self) -> StrictModel:
        """What the YAML said: scripted policies are built from it."""
        ...

    def begin(self, arena: int, seed: int, episode: int) -> Float64Array:
        """Forgets ``arena``'s last episode; (d, 2) start positions in m of the new one."""
        ...

    def observe(self, running: BoolArray, world: World, out: Buffers) -> None:
        """Fills obs, state, available and sites_done of the running arenas."""
        ...

    def command(self, running: BoolArray, actions: IntArray, world: World) -> None:
        """Turns the running arenas' actions (B, n) into commanded velocities.

        Called before every advance of the physics: more than once in a control step, with the
        same actions, where ``world.dt_s`` is a part of ``spec.dt_s``.
        """
        ...

    def settle(self, running: BoolArray, world: World, out: Buffers) -> None:
        """After the physics: fills reward and flags, which are cleared, of the running arenas,
        then observes."""
        ...


@dataclass(frozen=True)
class Kind:
    """A kind of scenario: its configuration and how to build it (config, name, n_arenas)."""

    config: type[StrictModel]
    build: Callable[[Any, str, int], Scenario]


def robot_names(n: int) -> tuple[str, ...]:
    return tuple(f"robot_{i + 1}" for i in range(n))


def episode_rng(seed: int, episode: int) -> np.random.Generator:
    """The generator of everything random in an episode, keyed by (seed, episode) alone."""
    key: npt.NDArray[np.uint64] = np.array([seed, episode], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))
