"""Reset and step of a batch of arenas: composes a scenario with the physics."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import (
    BoolArray,
    EnvSpec,
    EpisodeArray,
    FloatArray,
    IntArray,
    StepResult,
)
from crash_coach_common.strict_yaml import ConfigError, StrictModel, did_you_mean, validate
from sim_pkg.compiled import entry
from sim_pkg.foreign.config import KIND as FOREIGN
from sim_pkg.scenario_files import scenario_names
from sim_pkg.scenario_source import ScenarioSource, read_scenario
from sim_pkg.scenarios.base import Buffers, Scenario, Scene
from sim_pkg.scenarios.kinds import KINDS
from sim_pkg.world import Float64Array, World

if TYPE_CHECKING:
    from sim_pkg.foreign.env import ForeignEnv

__all__ = ["Env", "ScenarioLike", "make_any_env", "make_env", "scenario_names"]

ScenarioLike = str | Path | ScenarioSource
"""What an environment can be made of: a name, a file, a reference, or what was read of one."""


def make_env(scenario: ScenarioLike, n_arenas: int) -> Env:
    """B independent arenas of a scenario of ours: with bodies, positions and pictures.

    Args:
        scenario: a name of ``scenario_names()``, the path of a YAML file, or what was read of it.
        n_arenas: at least 1.

    Raises:
        ConfigError: unknown scenario, a file that is wrong (which key, and why), or an environment
            of somebody else.
        ValueError: n_arenas below 1.
    """
    if n_arenas < 1:
        raise ValueError(f"n_arenas is {n_arenas}; at least 1 is needed")
    source = _source(scenario)
    tree = source.tree()
    kind = tree.values.get("kind")
    if kind == FOREIGN:
        raise ConfigError(
            f"scenario {source.name!r} is a PettingZoo environment: that is played in one process "
            "only, it has no bodies, no ROS graph and no recordings"
        )
    if not isinstance(kind, str) or kind not in KINDS:
        known = [*KINDS, FOREIGN]
        raise ConfigError(
            f"{tree.where(('kind',))}: kind = {kind!r}{did_you_mean(str(kind), known)}; "
            f"one of: {', '.join(known)}"
        )
    config = validate(tree, KINDS[kind].config)
    return Env(KINDS[kind].build(config, source.name, n_arenas), n_arenas)


def make_any_env(scenario: ScenarioLike, n_arenas: int, pictures: bool = False) -> Env | ForeignEnv:
    """As ``make_env``, also of ``pettingzoo:`` environments.

    pictures: the environment of somebody else will be asked to draw itself.
    """
    source = _source(scenario)
    foreign = source.foreign()
    if foreign is None:
        return make_env(source, n_arenas)
    # Imported here: who has scenarios of ours only needs no gymnasium.
    from sim_pkg.foreign.env import ForeignEnv

    return ForeignEnv(foreign, source.name, n_arenas, pictures)


def _source(scenario: ScenarioLike) -> ScenarioSource:
    return scenario if isinstance(scenario, ScenarioSource) else read_scenario(scenario)


class Env:
    """B arenas of one scenario; see contract.BatchEnv for every method."""

    def __init__(self, scenario: Scenario, n_arenas: int) -> None:
        self._scenario = scenario
        self._n_arenas = n_arenas
        self._world = World(scenario.world, n_arenas)
        self._positions_m = self._world.bodies[:, : scenario.spec.n_robots, :2]
        self._advances = round(scenario.spec.dt_s / scenario.world.dt_s)
        self._out = Buffers.allocate(
            scenario.spec, len(scenario.scene.sites_m), len(scenario.world.discs), n_arenas
        )
        self._running = np.zeros(n_arenas, dtype=np.bool_)
        self._starting = np.zeros(n_arenas, dtype=np.bool_)
        self._result = StepResult(
            self._out.reward, self._out.terminated, self._out.truncated, self._out.success
        )

    @property
    def spec(self) -> EnvSpec:
        return self._scenario.spec

    @property
    def scene(self) -> Scene:
        """What can be drawn of the scenario."""
        return self._scenario.scene

    @property
    def config(self) -> StrictModel:
        """The scenario's configuration, as read from its YAML."""
        return self._scenario.config

    @property
    def world(self) -> World:
        """The physics; to be read only."""
        return self._world

    @property
    def n_arenas(self) -> int:
        return self._n_arenas

    @property
    def obs(self) -> FloatArray:
        return self._out.obs

    @property
    def state(self) -> FloatArray:
        return self._out.state

    @property
    def available(self) -> BoolArray:
        return self._out.available

    @property
    def positions_m(self) -> FloatArray:
        return self._positions_m.astype(np.float32)

    @property
    def velocities_mps(self) -> Float64Array:
        """(B, n, 2) vx, vy of each robot."""
        return self._world.bodies[:, : self.spec.n_robots, 2:]

    @property
    def sites_done(self) -> BoolArray:
        """(B, m) which of the scene's sites are done with (a button: touched)."""
        return self._out.sites_done

    @property
    def hits(self) -> FloatArray:
        """(B, d, d) how much health and shield disc i took from disc j in the last step."""
        return self._out.hits

    @property
    def running(self) -> BoolArray:
        """(B,) arenas whose episode has started and not ended."""
        return self._running

    def reset(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        """Starts episode ``episodes[i]`` in arena ``arenas[i]``.

        Raises:
            ValueError: lengths differ, an arena out of range or named twice, or a negative key.
        """
        which = np.asarray(arenas)
        numbers = np.asarray(episodes)
        if which.ndim != 1 or which.shape != numbers.shape:
            raise ValueError(f"{which.shape} arenas do not match {numbers.shape} episodes")
        self._starting[:] = False
        for arena, episode in zip(which.tolist(), numbers.tolist(), strict=True):
            self._begin(arena, seed, episode)
        self._scenario.observe(self._starting, self._world, self._out)
        self._running |= self._starting

    def step(self, actions: IntArray) -> StepResult:
        """One control step of every running arena; see contract.BatchEnv.step."""
        out, running = self._out, self._running
        self._check(actions)
        for _ in range(self._advances):
            self._scenario.command(running, actions, self._world)
            self._world.advance(running)
        out.clear_outcome()
        self._scenario.settle(running, self._world, out)
        _stop_ended(running, out.terminated, out.truncated)
        return self._result

    def _begin(self, arena: int, seed: int, episode: int) -> None:
        if not 0 <= arena < self._n_arenas:
            raise ValueError(f"no arena {arena}; there are 0..{self._n_arenas - 1}")
        if self._starting[arena]:
            raise ValueError(f"arena {arena} is named twice")
        if seed < 0 or episode < 0:
            raise ValueError(f"seed {seed} and episode {episode} must not be negative")
        self._starting[arena] = True
        self._out.hits[arena] = 0.0
        self._world.place(arena, self._scenario.begin(arena, seed, episode))

    def _check(self, actions: IntArray) -> None:
        spec = self.spec
        shape = (self._n_arenas, spec.n_robots)
        if actions.shape != shape or actions.dtype.kind != "i":
            raise ValueError(
                f"actions have shape {actions.shape} and dtype {actions.dtype}; "
                f"expected {shape} and int32"
            )
        wrong = _first_unavailable(self._running, actions, self._out.available)
        if wrong >= 0:
            arena, robot = divmod(wrong, spec.n_robots)
            action = int(actions[arena, robot])
            allowed = np.flatnonzero(self._out.available[arena, robot]).tolist()
            raise ValueError(
                f"action {action} of {spec.robots[robot]} in arena {arena} is not available; "
                f"available: {allowed} of {dict(enumerate(spec.action_names))}"
            )


@entry
def _stop_ended(running, terminated, truncated):  # type: ignore[no-untyped-def]
    for b in range(running.shape[0]):
        if terminated[b] or truncated[b]:
            running[b] = False


@entry
def _first_unavailable(running, actions, available):  # type: ignore[no-untyped-def]
    """Flat (arena, robot) index of the first action that is not allowed, or -1."""
    n_actions = available.shape[2]
    for b in range(actions.shape[0]):
        if not running[b]:
            continue
        for i in range(actions.shape[1]):
            action = actions[b, i]
            if action < 0 or action >= n_actions or not available[b, i, action]:
                return b * actions.shape[1] + i
    return -1
