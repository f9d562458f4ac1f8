"""The skirmish's numbers as arrays for compiled code: constants of the units, state of the fight.

d discs: the n robots, then the m opponents. The names below are columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crash_coach_common.contract import FloatArray, IntArray
from sim_pkg.scenarios.skirmish.config import SkirmishConfig, UnitConfig
from sim_pkg.world import Float64Array

# Of a unit, constant: (d, UNIT_COLUMNS) float64.
(
    MAX_HEALTH, MAX_SHIELD, SHIELD_PER_S, SHIELD_AFTER_S, ARMOUR, COOLDOWN_S, SPEED_MPS,
    BODY_RADIUS_M, N_HITS, UNIT_COLUMNS,
) = range(10)  # fmt: skip

# Of a unit, changing: (B, d, REAL_COLUMNS) float64.
# READY, STARTED and HURT are times of the arena's clock: when its next attack may start, when its
# present one did, when it was last hit. OLD: where it was when the phase began. POINT: where it was
# ordered to go. CHASE: seconds for which an opponent's target has been out of its reach.
(
    HEALTH, SHIELD, READY, STARTED, HURT, OLD_X, OLD_Y, POINT_X, POINT_Y, CHASE, REAL_COLUMNS,
) = range(11)  # fmt: skip

# Of a unit, changing: (B, d, WHOLE_COLUMNS) int32; discs by number, -1: none.
# TARGET: whom to attack. VICTIM: whom the present attack hits. NEXT_HIT: of the present attack.
# ATTACKS: started so far. HITTER: who hit it last since it last looked for a target. SIDE: on
# which side it goes around what is in its way, 0: nothing is.
ALIVE, ORDER, TARGET, VICTIM, NEXT_HIT, ATTACKS, HITTER, SIDE, LAST_ACTION, WHOLE_COLUMNS = range(
    10
)

# Values of ORDER.
HALT, GO, ATTACK = range(3)

# A whole row when an episode begins.
FRESH = np.full(WHOLE_COLUMNS, -1, dtype=np.int32)
FRESH[ALIVE] = 1
FRESH[[ORDER, ATTACKS, SIDE]] = HALT, 0, 0

# A random extra on the cooldown of each attack.
EXTRA_S = (-0.0625, 0.125)


@dataclass(frozen=True)
class Tables:
    """Constants of a map."""

    units: Float64Array  # (d, UNIT_COLUMNS)
    hits_s: Float64Array  # (d, h) when each hit of an attack lands
    damage: Float64Array  # (d, d) of one hit of i on j, before armour
    reach_m: Float64Array  # (d, d) centre to centre
    acquire_m: Float64Array  # (d, d) centre to centre: within this, i attacks j by itself
    leash_m: Float64Array  # (d, d) centre to centre: farther away, i gives j up
    starts_m: Float64Array  # (d, 2)
    free_m: Float64Array  # (4,) x1, y1, x2, y2
    goal_m: Float64Array  # (2,) where the opponents go
    type_bits: FloatArray  # (d, number of type names)
    standing: tuple[float, int]  # the opponents' health and shield together; how many they are
    jitter_m: float  # of the starts, in x and y
    n_attacks: int  # more than a unit can start in an episode

    @classmethod
    def of(cls, config: SkirmishConfig) -> Tables:
        units, layout = config.units, config.layout
        theirs = units[len(config.robots) :]
        h = max(len(unit.hits_s) for unit in units)
        hits_s = np.full((len(units), h), np.inf)
        for row, unit in zip(hits_s, units, strict=True):
            row[: len(unit.hits_s)] = unit.hits_s
        radius = np.array([unit.radius_m for unit in units])
        edges = radius[:, None] + radius[None, :]
        armoured = np.array([unit.armoured for unit in units])
        bonus = np.array([unit.damage_to_armoured for unit in units])
        reach = np.array([unit.reach_m for unit in units])
        starts_m = np.array([placed.start_m for placed in config.placed], dtype=np.float64)
        seconds = config.dt_s * config.episode_limit
        shortest_s = min(unit.cooldown_s for unit in units) + EXTRA_S[0]
        return cls(
            units=np.array([_columns(unit) for unit in units]),
            hits_s=hits_s,
            damage=np.array([u.damage for u in units])[:, None] + bonus[:, None] * armoured,
            reach_m=reach[:, None] + edges,
            acquire_m=np.maximum(reach, config.behaviour.acquire_m)[:, None] + edges,
            leash_m=config.behaviour.leash_m + edges,
            starts_m=starts_m,
            free_m=np.array(config.free_m),
            goal_m=starts_m[: len(config.robots)].mean(axis=0),
            type_bits=np.array([layout.type_bits(p.unit) for p in config.placed]),
            standing=(sum(u.health + u.shield for u in theirs), len(theirs)),
            jitter_m=config.jitter_m,
            n_attacks=int(seconds / shortest_s) + 2,
        )


def _columns(unit: UnitConfig) -> list[float]:
    row = [0.0] * UNIT_COLUMNS
    row[MAX_HEALTH] = unit.health
    row[MAX_SHIELD] = unit.shield
    row[SHIELD_PER_S] = unit.shield_per_s
    row[SHIELD_AFTER_S] = unit.shield_after_s
    row[ARMOUR] = unit.armour
    row[COOLDOWN_S] = unit.cooldown_s
    row[SPEED_MPS] = unit.speed_mps
    row[BODY_RADIUS_M] = unit.body_radius_m
    row[N_HITS] = len(unit.hits_s)
    return row


@dataclass(frozen=True)
class Fight:
    """What changes, over B arenas."""

    real: Float64Array  # (B, d, REAL_COLUMNS)
    whole: IntArray  # (B, d, WHOLE_COLUMNS)
    extras_s: Float64Array  # (B, d, n_attacks) random extra on the cooldown of each attack
    clock_s: Float64Array  # (B,)
    steps: IntArray  # (B,)
    standing: Float64Array  # (B, 2) the opponents' health and shield together; how many live

    @classmethod
    def allocate(cls, tables: Tables, n_arenas: int) -> Fight:
        b, d = n_arenas, len(tables.units)
        return cls(
            real=np.zeros((b, d, REAL_COLUMNS)),
            whole=np.zeros((b, d, WHOLE_COLUMNS), dtype=np.int32),
            extras_s=np.zeros((b, d, tables.n_attacks)),
            clock_s=np.zeros(b),
            steps=np.zeros(b, dtype=np.int32),
            standing=np.zeros((b, 2)),
        )

    def begin(self, tables: Tables, arena: int, rng: np.random.Generator) -> Float64Array:
        """All whole and at their starts, nobody ordered. (d, 2) where they start."""
        real, whole = self.real[arena], self.whole[arena]
        shift_m = rng.uniform(-tables.jitter_m, tables.jitter_m, tables.starts_m.shape)
        starts_m: Float64Array = tables.starts_m + shift_m
        real[:] = 0.0
        real[:, HEALTH : SHIELD + 1] = tables.units[:, MAX_HEALTH : MAX_SHIELD + 1]
        real[:, OLD_X : OLD_Y + 1] = starts_m
        whole[:] = FRESH
        rng.random(out=self.extras_s[arena])
        self.extras_s[arena] *= EXTRA_S[1] - EXTRA_S[0]
        self.extras_s[arena] += EXTRA_S[0]
        self.clock_s[arena] = 0.0
        self.steps[arena] = 0
        self.standing[arena] = tables.standing
        return starts_m
