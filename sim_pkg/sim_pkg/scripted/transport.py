"""Reference policies of transport.

The robots line up side by side on one face of the box, and push together once all are there;
to push in another direction they move to another face. A robot that stands still away from the
box is left out of the line. ``transport_direct`` then goes on straight to the goal, and gets
stuck where the floor is rough; ``transport_adaptive`` pushes the box around it.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, EnvSpec, EpisodeArray, FloatArray, IntArray
from sim_pkg.compiled import entry
from sim_pkg.scenarios import drive
from sim_pkg.scenarios.transport import TransportConfig
from sim_pkg.scripted.base import Entry
from sim_pkg.scripted.driving import drive_to, read_others

# A robot that stays within _STILL_M for this many steps stands still.
_STILL_STEPS = 4
_LEFT_OUT = 1000000
_STILL_M = 0.1
# Free room: between robots in line, behind the box before the push, beside the rough floor.
_SPACING_M = 0.06
_CLEARANCE_M = 0.15
_BERTH_M = 0.3
# Way that is too short to push for.
_DONE_M = 0.1
# A robot this far beside its place in the line still pushes.
_LANE_M = 0.35
# Pushing, a robot aims this far ahead: the smaller, the harder it corrects its place in the line.
_AHEAD_M = 0.6
# Going around the box, a robot aims this far along the circle.
_ARC_RAD = 0.8


class TransportPolicy:
    """Both policies over ``n_arenas`` arenas.

    Memory of robot i: where it last saw each robot j move to, where the box was then, and how
    many steps ago that was; which face it pushes; whether it chose to go around, and whether the
    way to the goal was free since.
    """

    def __init__(
        self, spec: EnvSpec, config: TransportConfig, n_arenas: int, goes_around: bool
    ) -> None:
        n, box, robot = spec.n_robots, config.box, config.robot
        self._config = config
        self._goes_around = goes_around
        self._last_m = np.zeros((n_arenas, n, n, 4))
        self._still = np.zeros((n_arenas, n, n), dtype=np.int32)
        self._around = np.zeros((n_arenas, n), dtype=np.bool_)
        self._past = np.zeros((n_arenas, n), dtype=np.bool_)
        self._axis = np.zeros((n_arenas, n), dtype=np.int32)
        self._half_m = np.array([box.width_m, box.height_m]) / 2
        self._reach_m = float(np.hypot(*self._half_m)) + robot.radius_m
        self._rough_m = np.array(config.floor.rough).reshape(-1, 4)
        self._via_m = _way_around(config)

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        self._last_m[arenas] = np.inf
        self._still[arenas] = 0
        self._around[arenas] = False
        self._past[arenas] = False
        self._axis[arenas] = -1

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        config, robot = self._config, self._config.robot
        motion = (robot.max_speed_mps, robot.max_force_n / robot.mass_kg, config.dt_s)
        _act(
            obs, self._last_m, self._still, self._around, self._past, self._axis,
            self._goes_around, config.arena_m, config.sight_m, self._rough_m,
            self._via_m, self._half_m, self._reach_m, robot.radius_m, drive.DIRECTIONS, motion,
            actions,
        )  # fmt: skip


def _way_around(config: TransportConfig) -> tuple[float, float]:
    """x, y where the box passes the rough floor: north or south of it, where there is more room."""
    if not config.floor.rough:
        return config.goal
    _, y1, x2, y2 = np.array(config.floor.rough).T
    south, north = y1.min(), y2.max()
    northwards = config.arena_m[1] - north >= south
    y = north + 2 * _BERTH_M if northwards else south - 2 * _BERTH_M
    return float(x2.max() + 2 * _BERTH_M), float(y)


@entry
def _axis(way, angle, before, first):  # type: ignore[no-untyped-def]
    """Which face's direction to push in, 0..3: quarter turns from the box's own x axis.

    ``way``: (2,) m that are left to push. ``before``: the last answer, kept while there is
    way left in it; -1: none. ``first``: 1 to start along the box's y axis, 0 along x, -1 along
    the longer way.
    """
    along = (
        np.cos(angle) * way[0] + np.sin(angle) * way[1],
        np.cos(angle) * way[1] - np.sin(angle) * way[0],
    )
    if before >= 0:
        left = along[before % 2] if before < 2 else -along[before % 2]
        if left > _DONE_M:
            return before
    pick = first
    if first < 0 or abs(along[first]) <= _DONE_M:
        pick = 0 if abs(along[0]) >= abs(along[1]) else 1
    return pick if along[pick] > 0.0 else pick + 2


@entry
def _crosses(start, end, rough, berth_m):  # type: ignore[no-untyped-def]
    """Whether the straight way from start to end leads over rough floor or close by."""
    for step in range(41):
        x = start[0] + (end[0] - start[0]) * step / 40.0
        y = start[1] + (end[1] - start[1]) * step / 40.0
        for r in range(len(rough)):
            inside_x = rough[r, 0] - berth_m <= x <= rough[r, 2] + berth_m
            if inside_x and rough[r, 1] - berth_m <= y <= rough[r, 3] + berth_m:
                return True
    return False


@entry
def _count_still(place, box, last_m, still, reach_m):  # type: ignore[no-untyped-def]
    """For how many steps a robot that is seen at ``place`` has not moved.

    _LEFT_OUT once that is too long: at the box, where robots wait, longer than elsewhere, unless
    the box moved meanwhile. ``last_m``: place of the robot, then of the box, when it last moved.
    """
    if (place[0] - last_m[0]) ** 2 + (place[1] - last_m[1]) ** 2 > _STILL_M**2:
        last_m[0], last_m[1] = place
        last_m[2], last_m[3] = box
        return 0
    gap = np.sqrt((place[0] - box[0]) ** 2 + (place[1] - box[1]) ** 2)
    pushed = np.sqrt((box[0] - last_m[2]) ** 2 + (box[1] - last_m[3]) ** 2)
    patience = 3 * _STILL_STEPS
    if gap > 1.5 * reach_m or pushed > 4.0 * _STILL_M:
        patience = _STILL_STEPS
    return still + 1 if still + 1 < patience else _LEFT_OUT


@entry
def _line_up(here, others, active, direction, half_m, radius_m):  # type: ignore[no-untyped-def]
    """(along, beside, offset, all are behind) of a robot.

    ``here`` is relative to the box, ``others`` to the robot, in m.

    ``along`` the direction of the push and ``beside`` it; ``offset`` is the robot's place in
    the line, from the order in which the robots stand.
    """
    dx, dy = direction
    along = here[0] * dx + here[1] * dy
    beside = here[1] * dx - here[0] * dy
    size, rank, ready = 1, 0, True
    for j in range(len(others)):
        if not active[j]:
            continue
        size += 1
        if np.isnan(others[j, 0]):
            ready = False
            continue
        its_along = (here[0] + others[j, 0]) * dx + (here[1] + others[j, 1]) * dy
        its_beside = (here[1] + others[j, 1]) * dx - (here[0] + others[j, 0]) * dy
        if its_beside < beside:
            rank += 1
        behind = -half_m - 4.0 * radius_m < its_along < -half_m
        ready = ready and behind and abs(its_beside) < half_m + radius_m
    spacing = 2.0 * radius_m + _SPACING_M
    return along, beside, (rank - 0.5 * (size - 1)) * spacing, ready


@entry
def _approach(here, place, reach_m):  # type: ignore[no-untyped-def]
    """Where to go next on the way from ``here`` to ``place`` around the box, relative to it."""
    dx, dy = place[0] - here[0], place[1] - here[1]
    length = dx * dx + dy * dy
    nearest = 0.0
    if length > 0.0:
        nearest = min(max(-(here[0] * dx + here[1] * dy) / length, 0.0), 1.0)
    x, y = here[0] + nearest * dx, here[1] + nearest * dy
    angle = np.arctan2(here[1], here[0])
    turn = np.arctan2(place[1], place[0]) - angle
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    if x * x + y * y >= reach_m * reach_m or abs(turn) < _ARC_RAD:
        return place
    angle += _ARC_RAD if turn > 0.0 else -_ARC_RAD
    radius = reach_m + 2.0 * _CLEARANCE_M
    return radius * np.cos(angle), radius * np.sin(angle)


@entry
def _towards(x, y, directions):  # type: ignore[no-untyped-def]
    """The action whose direction is nearest to (x, y)."""
    best, best_dot = 0, -np.inf
    for action in range(1, len(directions)):
        dot = x * directions[action, 0] + y * directions[action, 1]
        if dot > best_dot:
            best, best_dot = action, dot
    return best


@entry
def _push(  # type: ignore[no-untyped-def]
    here, velocity, others, active, direction, half_m, reach_m, radius_m, directions, motion
):
    """A robot's action; ``here`` is relative to the box, ``others`` to the robot, in m."""
    along, beside, offset, ready = _line_up(here, others, active, direction, half_m, radius_m)
    if ready and along < -half_m and abs(beside - offset) < _LANE_M:
        aside = offset - beside
        x = _AHEAD_M * direction[0] - aside * direction[1]
        y = _AHEAD_M * direction[1] + aside * direction[0]
        return _towards(x, y, directions)
    depth = half_m + radius_m + _CLEARANCE_M
    place = (
        -depth * direction[0] - offset * direction[1],
        -depth * direction[1] + offset * direction[0],
    )
    x, y = _approach(here, place, reach_m)
    speed_mps, accel_mps2, dt_s = motion
    return drive_to(
        (x - here[0], y - here[1]), velocity, others, 2.0 * radius_m + _SPACING_M, directions,
        speed_mps, accel_mps2, dt_s,
    )  # fmt: skip


@entry
def _act(  # type: ignore[no-untyped-def]
    obs, last_m, still, around, past, axis, goes_around, arena_m, sight_m, rough, via, half_m,
    reach_m, radius_m, directions, motion, actions,
):  # fmt: skip
    n = actions.shape[1]
    others = np.zeros((n - 1, 2))
    active = np.ones(n - 1, dtype=np.bool_)
    for b in range(len(obs)):
        for i in range(n):
            row = obs[b, i]
            x, y = 0.5 * (row[0] + 1.0) * arena_m[0], 0.5 * (row[1] + 1.0) * arena_m[1]
            here = (-row[4] * arena_m[0], -row[5] * arena_m[1])
            box = (x - here[0], y - here[1])
            goal = (x + row[10] * arena_m[0], y + row[11] * arena_m[1])
            read_others(row[12:], sight_m, others)
            for k in range(n - 1):
                j = k if k < i else k + 1
                if not np.isnan(others[k, 0]):
                    place = (x + others[k, 0], y + others[k, 1])
                    still[b, i, j] = _count_still(
                        place, box, last_m[b, i, j], still[b, i, j], reach_m
                    )
                active[k] = still[b, i, j] < _LEFT_OUT
            if goes_around and not around[b, i] and not active.all():
                around[b, i], axis[b, i] = True, -1
            past[b, i] |= not _crosses(box, goal, rough, _BERTH_M)
            detour = around[b, i] and not past[b, i]
            target = via if detour else goal
            angle = np.arctan2(row[7], row[6])
            axis[b, i] = _axis(
                (target[0] - box[0], target[1] - box[1]), angle, axis[b, i], 1 if detour else -1
            )
            angle += 0.5 * np.pi * axis[b, i]
            actions[b, i] = _push(
                here, (row[2] * motion[0], row[3] * motion[0]), others, active,
                (np.cos(angle), np.sin(angle)), half_m[axis[b, i] % 2], reach_m, radius_m,
                directions, motion,
            )  # fmt: skip


ENTRIES = {
    "transport_direct": Entry(TransportConfig, partial(TransportPolicy, goes_around=False)),
    "transport_adaptive": Entry(TransportConfig, partial(TransportPolicy, goes_around=True)),
}
