"""Where everything is in a skirmish's observation, state and action numbers.

SMAC's layout. With n robots and m opponents:

observation: 4 move availabilities (north, south, east, west)
    | m opponents: attackable, distance, dx, dy, health, [shield], [type bits]
    | n-1 allies in robot order without oneself: visible, distance, dx, dy, health, [shield], [type]
    | own: health, [shield], [type]
state: n robots: health, cooldown, x, y, [shield], [type]
    | m opponents: health, x, y, [shield], [type]
    | n robots: last action, one-hot

Distances, dx and dy (other minus own) are shares of ``SIGHT_M``; health, shield and cooldown are
shares of their largest value; x and y are offsets from the arena's centre as shares of its width
and height. What is out of sight or dead is all zeros, and so is everything a dead robot observes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crash_coach_common.contract import FloatArray

NO_OP, STOP, NORTH, SOUTH, EAST, WEST, FIRST_ATTACK = range(7)
MOVES = ("north", "south", "east", "west")

SIGHT_M = 9.0  # centre to centre
ATTACK_M = 6.0  # an attack may be ordered within this, centre to centre, whatever the unit
MOVE_M = 2.0  # how far away the point of a move order is

# Columns of an opponent's and of an ally's part of an observation; shield and type bits follow.
ATTACKABLE = VISIBLE = 0
DISTANCE, DX, DY, HEALTH = 1, 2, 3, 4
# Columns of a robot's part of the state and of an opponent's; the shield where a team has one.
STATE_HEALTH, STATE_COOLDOWN, STATE_SHIELD = 0, 1, 4
STATE_OPPONENT_HEALTH, STATE_OPPONENT_SHIELD = 0, 3


@dataclass(frozen=True)
class ObservationParts:
    """Views into observations (..., O)."""

    moves: FloatArray  # (..., 4)
    opponents: FloatArray  # (..., m, opponent_width)
    allies: FloatArray  # (..., n-1, ally_width)
    own: FloatArray  # (..., own_width)


@dataclass(frozen=True)
class StateParts:
    """Views into states (..., S)."""

    robots: FloatArray  # (..., n, state_robot_width)
    opponents: FloatArray  # (..., m, state_opponent_width)
    last_actions: FloatArray  # (..., n, A)


@dataclass(frozen=True)
class Layout:
    """Sizes and offsets for one composition of teams.

    ``robot_shields``, ``opponent_shields``: whether any unit of that team has a shield.
    ``type_names``: the map's unit types, one bit each, where a team mixes types; else empty.
    """

    n_robots: int
    n_opponents: int
    robot_shields: bool
    opponent_shields: bool
    type_names: tuple[str, ...] = ()

    @classmethod
    def of(cls, robots: Sequence[str], opponents: Sequence[str], shielded: Sequence[str]) -> Layout:
        """From the unit type of each robot and opponent, and the types that have a shield."""
        mixed = len(set(robots)) > 1 or len(set(opponents)) > 1
        return cls(
            n_robots=len(robots),
            n_opponents=len(opponents),
            robot_shields=bool(set(robots) & set(shielded)),
            opponent_shields=bool(set(opponents) & set(shielded)),
            # In order of first appearance.
            type_names=tuple(dict.fromkeys((*robots, *opponents))) if mixed else (),
        )

    @property
    def action_names(self) -> tuple[str, ...]:
        attacks = (f"attack_{j + 1}" for j in range(self.n_opponents))
        return ("no_op", "stop", *MOVES, *attacks)

    @property
    def n_actions(self) -> int:
        return FIRST_ATTACK + self.n_opponents

    @property
    def opponent_width(self) -> int:
        return 5 + self.opponent_shields + len(self.type_names)

    @property
    def ally_width(self) -> int:
        return 5 + self.robot_shields + len(self.type_names)

    @property
    def own_width(self) -> int:
        return 1 + self.robot_shields + len(self.type_names)

    @property
    def opponents_at(self) -> int:
        """First feature of the first opponent in an observation."""
        return len(MOVES)

    @property
    def allies_at(self) -> int:
        return self.opponents_at + self.n_opponents * self.opponent_width

    @property
    def own_at(self) -> int:
        return self.allies_at + (self.n_robots - 1) * self.ally_width

    @property
    def obs_size(self) -> int:
        return self.own_at + self.own_width

    @property
    def state_robot_width(self) -> int:
        return 4 + self.robot_shields + len(self.type_names)

    @property
    def state_opponent_width(self) -> int:
        return 3 + self.opponent_shields + len(self.type_names)

    @property
    def state_opponents_at(self) -> int:
        return self.n_robots * self.state_robot_width

    @property
    def state_actions_at(self) -> int:
        return self.state_opponents_at + self.n_opponents * self.state_opponent_width

    @property
    def state_size(self) -> int:
        return self.state_actions_at + self.n_robots * self.n_actions

    def split_obs(self, obs: FloatArray) -> ObservationParts:
        """(..., O) observations by their parts."""
        lead = obs.shape[:-1]
        opponents = obs[..., self.opponents_at : self.allies_at]
        allies = obs[..., self.allies_at : self.own_at]
        return ObservationParts(
            moves=obs[..., : self.opponents_at],
            opponents=opponents.reshape(*lead, self.n_opponents, self.opponent_width),
            allies=allies.reshape(*lead, self.n_robots - 1, self.ally_width),
            own=obs[..., self.own_at :],
        )

    def split_state(self, state: FloatArray) -> StateParts:
        """(..., S) states by their parts."""
        lead = state.shape[:-1]
        robots = state[..., : self.state_opponents_at]
        opponents = state[..., self.state_opponents_at : self.state_actions_at]
        actions = state[..., self.state_actions_at :]
        return StateParts(
            robots=robots.reshape(*lead, self.n_robots, self.state_robot_width),
            opponents=opponents.reshape(*lead, self.n_opponents, self.state_opponent_width),
            last_actions=actions.reshape(*lead, self.n_robots, self.n_actions),
        )

    def type_bits(self, unit: str) -> FloatArray:
        """(number of type names,) one-hot."""
        return np.array([unit == name for name in self.type_names], dtype=np.float32)
