"""Scripted policies of skirmish.

``nearest``: attacks the nearest opponent that it may attack, else walks to the nearest in sight,
else east. ``focus``: the same with the weakest. ``kite``: attacks when its weapon is ready and no
opponent could strike it meanwhile; else steps back. ``alternate``: the robot that is chased runs,
the others attack.

Own position and cooldown are not observed, so a robot counts the steps since its last attack and
takes the rest (its own and the opponents' unit types) from the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from sim_pkg.contract import BoolArray, EnvSpec, EpisodeArray, FloatArray, IntArray
from sim_pkg.scenarios.skirmish_config import SkirmishConfig
from sim_pkg.scenarios.skirmish_layout import (
    DISTANCE,
    DX,
    DY,
    FIRST_ATTACK,
    NO_OP,
    SIGHT_M,
    STOP,
    VISIBLE,
)
from sim_pkg.scenarios.skirmish_tables import EXTRA_S
from sim_pkg.scripted.base import Entry
from sim_pkg.scripted.skirmish_moves import (
    AWAY,
    CAN,
    LEFT,
    SEEN,
    VIEW_COLUMNS,
    X,
    Y,
    advance,
    flee,
    least,
    look,
)
from sim_pkg.world import Float64Array

# An opponent is a threat when it could strike after a step, and so much farther away.
_MARGIN_M = 0.15


@dataclass(frozen=True)
class _Map:
    """What robots know of the map: places in their observation, and the units' data."""

    first: int  # opponents in the observation: where the first begins ...
    width: int  # ... and how many features each has
    shielded: bool
    ally_first: int
    ally_width: int
    full: Float64Array  # (m, 2) opponents' largest health and shield
    speed_mps: Float64Array  # (n + m,)
    reach_m: Float64Array  # (n + m, n + m) centre to centre
    rest: IntArray  # (n,) steps from an attack to the next

    @classmethod
    def of(cls, config: SkirmishConfig) -> _Map:
        layout, n, units = config.layout, len(config.robots), config.units
        radius = np.array([unit.radius_m for unit in units])
        reach = np.array([unit.reach_m for unit in units])
        # As early as it may be ready: it attacks as soon as it is.
        rest = [math.ceil((unit.cooldown_s + EXTRA_S[0]) / config.dt_s) for unit in units[:n]]
        return cls(
            first=layout.opponents_at,
            width=layout.opponent_width,
            shielded=layout.opponent_shields,
            ally_first=layout.allies_at,
            ally_width=layout.ally_width,
            full=np.array([(unit.health, unit.shield) for unit in units[n:]]),
            speed_mps=np.array([unit.speed_mps for unit in units]),
            reach_m=reach[:, None] + radius[:, None] + radius[None, :],
            rest=np.array(rest, dtype=np.int32),
        )


class Charge:
    """``nearest`` and ``focus``: which attackable opponent, by a column of the view."""

    def __init__(self, config: SkirmishConfig, by: int) -> None:
        self._map = _Map.of(config)
        self._by = by

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        """Nothing to forget."""

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        m = self._map
        _charge(obs, available, m.first, m.width, m.shielded, m.full, self._by, actions)


class Evade:
    """``kite`` and ``alternate``: robots that avoid whoever must come close to strike.

    Args:
        chased_only: flee only from opponents to which no ally in sight is nearer, and attack
            from where they stand (alternate); else step back between attacks too (kite).
    """

    def __init__(
        self, spec: EnvSpec, config: SkirmishConfig, n_arenas: int, chased_only: bool
    ) -> None:
        self._map = _Map.of(config)
        self._dt_s = spec.dt_s
        self._chased_only = chased_only
        shape = (n_arenas, spec.n_robots)
        # Steps since the robot's last attack, and the move it made last.
        self._since: IntArray = np.zeros(shape, dtype=np.int32)
        self._last: IntArray = np.zeros(shape, dtype=np.int32)

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        self._since[arenas] = 1000
        self._last[arenas] = STOP

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        m = self._map
        _evade(
            obs, available, (m.first, m.width, m.ally_first, m.ally_width), m.shielded, m.full,
            m.speed_mps, m.reach_m, m.rest, self._dt_s, self._chased_only, self._since,
            self._last, actions,
        )  # fmt: skip


@njit(cache=True)
def _charge(obs, available, first, width, shielded, full, by, actions):  # type: ignore[no-untyped-def]
    view = np.zeros((len(full), VIEW_COLUMNS))
    for b in range(obs.shape[0]):
        for i in range(obs.shape[1]):
            free = available[b, i]
            if free[NO_OP]:
                actions[b, i] = NO_OP
                continue
            look(obs[b, i], first, width, shielded, full, free, view)
            target = least(view, CAN, by)
            actions[b, i] = FIRST_ATTACK + target if target >= 0 else advance(view, free)


@njit(cache=True)
def _evade(  # type: ignore[no-untyped-def]
    obs, available, places, shielded, full, speed, reach, rest, dt_s, chased_only, since, last,
    actions,
):  # fmt: skip
    n, m = obs.shape[1], len(full)
    view, threats = np.zeros((m, VIEW_COLUMNS)), np.zeros(m, dtype=np.bool_)
    for b in range(obs.shape[0]):
        for i in range(n):
            free = available[b, i]
            if free[NO_OP]:
                actions[b, i] = NO_OP
                continue
            look(obs[b, i], places[0], places[1], shielded, full, free, view)
            since[b, i] += 1
            ready = since[b, i] >= rest[i]
            back = not chased_only and not ready
            for j in range(m):
                threats[j] = _threatens(i, j, n, view[j], speed, reach, dt_s, back)
                if threats[j] and chased_only:
                    threats[j] = _chased(view[j], obs[b, i], n, places)
            target = least(view, CAN, AWAY)
            if threats.any():
                action = flee(view, threats, speed[i], speed[n:], free, last[b, i])
                last[b, i] = action
            elif target >= 0:
                action = FIRST_ATTACK + target
                if ready and view[target, AWAY] <= reach[i, n + target]:
                    since[b, i] = 0
            else:
                action = advance(view, free)
            actions[b, i] = action


@njit(cache=True)
def _threatens(i, j, n, seen, speed, reach, dt_s, back):  # type: ignore[no-untyped-def]
    """Whether robot i has to step away from opponent j, which must come closer to strike."""
    if seen[SEEN] == 0.0 or reach[n + j, i] >= reach[i, n + j]:
        return False
    if back:
        return seen[AWAY] < reach[i, n + j]
    return seen[AWAY] < reach[n + j, i] + speed[n + j] * dt_s + _MARGIN_M


@njit(cache=True)
def _chased(seen, row, n, places):  # type: ignore[no-untyped-def]
    """Whether no ally in sight is nearer to the opponent."""
    for k in range(n - 1):
        part = row[places[2] + k * places[3] : places[2] + (k + 1) * places[3]]
        if part[VISIBLE] > 0.0 and part[DISTANCE] > 0.0:
            x, y = part[DX] * SIGHT_M - seen[X], part[DY] * SIGHT_M - seen[Y]
            if x * x + y * y < seen[AWAY] * seen[AWAY]:
                return False
    return True


ENTRIES = {
    "nearest": Entry(SkirmishConfig, lambda spec, config, b: Charge(config, AWAY)),
    "focus": Entry(SkirmishConfig, lambda spec, config, b: Charge(config, LEFT)),
    "kite": Entry(SkirmishConfig, lambda spec, config, b: Evade(spec, config, b, False)),
    "alternate": Entry(SkirmishConfig, lambda spec, config, b: Evade(spec, config, b, True)),
}
