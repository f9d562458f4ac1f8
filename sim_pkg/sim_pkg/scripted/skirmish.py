"""Scripted policies of skirmish.

``nearest``: attacks the nearest opponent that it may attack, else walks to the nearest in sight,
else east. ``focus``: the same, but of those within its reach it attacks the weakest. ``kite``: as
focus, but a robot whose weapon outranges an opponent's attacks only where that opponent cannot
strike it before the step is over, and steps back while its weapon is not ready. ``alternate``:
as kite, but only the robot that is chased steps back, while the others stand and attack.

Own position and cooldown are not observed, so a robot counts the steps since its last attack and
takes the rest (its own and the opponents' unit types) from the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, EnvSpec, EpisodeArray, FloatArray, IntArray
from sim_pkg.compiled import entry
from sim_pkg.scenarios.skirmish.config import SkirmishConfig
from sim_pkg.scenarios.skirmish.layout import (
    DISTANCE,
    DX,
    DY,
    FIRST_ATTACK,
    NO_OP,
    SIGHT_M,
    STOP,
    VISIBLE,
)
from sim_pkg.scenarios.skirmish.tables import (
    COOLDOWN_S,
    EXTRA_S,
    MAX_HEALTH,
    MAX_SHIELD,
    SPEED_MPS,
    Tables,
)
from sim_pkg.scripted.base import Entry
from sim_pkg.scripted.skirmish_moves import (
    AWAY,
    CAN,
    SEEN,
    VIEW_COLUMNS,
    X,
    Y,
    advance,
    flee,
    least,
    look,
    pick,
)
from sim_pkg.world import Float64Array

# An opponent is a threat where it could strike after the next step, and so much farther away.
_KITE_MARGIN_M = 0.1
_CHASED_MARGIN_M = 0.9
# The chased robot steps back from so much farther away while its weapon is not ready.
_CHASED_BACK_M = 3.7
# Who is nearer to an opponent than any ally, or farther by so much, may be the one it chases.
_NEARER_M = 0.4


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
        layout, n, tables = config.layout, len(config.robots), Tables.of(config)
        # As early as it may be ready: it attacks as soon as it is.
        rest = np.ceil((tables.units[:n, COOLDOWN_S] + EXTRA_S[0]) / config.dt_s)
        return cls(
            first=layout.opponents_at,
            width=layout.opponent_width,
            shielded=layout.opponent_shields,
            ally_first=layout.allies_at,
            ally_width=layout.ally_width,
            full=tables.units[n:, [MAX_HEALTH, MAX_SHIELD]],
            speed_mps=tables.units[:, SPEED_MPS],
            reach_m=tables.reach_m,
            rest=rest.astype(np.int32),
        )


class Charge:
    """``nearest`` and, with ``weakest``, ``focus``."""

    def __init__(self, config: SkirmishConfig, weakest: bool) -> None:
        self._map = _Map.of(config)
        self._weakest = weakest

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        """Nothing to forget."""

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        m = self._map
        _charge(
            obs, available, m.first, m.width, m.shielded, m.full, m.reach_m, self._weakest, actions
        )


class Evade:
    """``kite`` and, with ``chased_only``, ``alternate``."""

    def __init__(
        self, spec: EnvSpec, config: SkirmishConfig, n_arenas: int, chased_only: bool
    ) -> None:
        self._map = m = _Map.of(config)
        self._chased_only = chased_only
        n, shape = spec.n_robots, (n_arenas, spec.n_robots)
        strike_m = m.reach_m.T[:n, n:] + m.speed_mps[n:] * spec.dt_s
        outranged = m.reach_m[:n, n:] > m.reach_m.T[:n, n:]
        # (n, m): robot i steps away from opponent j within this, when its weapon is ready ...
        margin_m = _CHASED_MARGIN_M if chased_only else _KITE_MARGIN_M
        self._danger_m = np.where(outranged, strike_m + margin_m, 0.0)
        # ... and while it is not.
        back_m = strike_m + _CHASED_BACK_M if chased_only else m.reach_m[:n, n:]
        self._back_m = np.where(outranged, back_m, 0.0)
        # Steps since the robot's last attack, and the way it fled last.
        self._since: IntArray = np.zeros(shape, dtype=np.int32)
        self._fled: IntArray = np.zeros(shape, dtype=np.int32)

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        self._since[arenas] = self._map.rest
        self._fled[arenas] = STOP

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        m = self._map
        _evade(
            obs, available, (m.first, m.width, m.ally_first, m.ally_width), m.shielded, m.full,
            m.speed_mps, m.reach_m, m.rest, self._danger_m, self._back_m, self._chased_only,
            self._since, self._fled, actions,
        )  # fmt: skip


@entry
def _charge(  # type: ignore[no-untyped-def]
    obs, available, first, width, shielded, full, reach, weakest, actions
):
    n, view = obs.shape[1], np.zeros((len(full), VIEW_COLUMNS))
    for b in range(obs.shape[0]):
        for i in range(n):
            free = available[b, i]
            if free[NO_OP]:
                actions[b, i] = NO_OP
                continue
            look(obs[b, i], first, width, shielded, full, free, view)
            target = pick(view, reach[i, n:]) if weakest else least(view, CAN, AWAY)
            actions[b, i] = FIRST_ATTACK + target if target >= 0 else advance(view, free)


@entry
def _evade(  # type: ignore[no-untyped-def]
    obs, available, places, shielded, full, speed, reach, rest, danger, back, chased_only, since,
    fled, actions,
):  # fmt: skip
    n, m = obs.shape[1], len(full)
    view, threats = np.zeros((m, VIEW_COLUMNS)), np.zeros(m, dtype=np.bool_)
    for b in range(obs.shape[0]):
        for i in range(n):
            free, row = available[b, i], obs[b, i]
            if free[NO_OP]:
                actions[b, i] = NO_OP
                continue
            look(row, places[0], places[1], shielded, full, free, view)
            since[b, i] += 1
            ready = since[b, i] >= rest[i]
            for j in range(m):
                near = danger[i, j] if ready else back[i, j]
                threats[j] = view[j, SEEN] > 0.0 and view[j, AWAY] < near
                if threats[j] and chased_only:
                    threats[j] = _chased(view[j], row, n, places)
            target = pick(view, reach[i, n:])
            if threats.any():
                fled[b, i] = flee(view, threats, speed[i], speed[n:], free, fled[b, i])
                actions[b, i] = fled[b, i]
            elif target >= 0:
                actions[b, i] = FIRST_ATTACK + target
                if ready and view[target, AWAY] <= reach[i, n + target]:
                    since[b, i] = 0
            else:
                actions[b, i] = advance(view, free)


@entry
def _chased(seen, row, n, places):  # type: ignore[no-untyped-def]
    """Whether no ally in sight is clearly nearer to the opponent."""
    for k in range(n - 1):
        part = row[places[2] + k * places[3] : places[2] + (k + 1) * places[3]]
        if part[VISIBLE] > 0.0 and part[DISTANCE] > 0.0:
            x, y = part[DX] * SIGHT_M - seen[X], part[DY] * SIGHT_M - seen[Y]
            if np.sqrt(x * x + y * y) < seen[AWAY] - _NEARER_M:
                return False
    return True


ENTRIES = {
    "nearest": Entry(SkirmishConfig, lambda spec, config, b: Charge(config, False)),
    "focus": Entry(SkirmishConfig, lambda spec, config, b: Charge(config, True)),
    "kite": Entry(SkirmishConfig, lambda spec, config, b: Evade(spec, config, b, False)),
    "alternate": Entry(SkirmishConfig, lambda spec, config, b: Evade(spec, config, b, True)),
}
