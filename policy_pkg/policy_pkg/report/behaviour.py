"""What a team does, measured in each episode: shared targets, distances, who takes the damage.

Working robots are those that live and that no fault is in force on. Distances lie between centres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from policy_pkg.report.finished_runs import Run
from policy_pkg.statistics import Estimate, holm, mean_interval, paired_p_value
from sim_pkg.render.frames import Frames, Side

Floats = npt.NDArray[np.float64]
NEAREST = 2  # working robots that count as neighbours of a crashed one
LEAST_SEEDS = 2  # for an interval


@dataclass(frozen=True)
class Measure:
    """One figure of an episode; NaN where the episode has nothing that it could be taken from."""

    name: str
    unit: str
    description: str
    of: Callable[[Frames], float]


def _working(frames: Frames) -> npt.NDArray[np.bool_]:
    """(T, n)"""
    alive = frames.alive[:-1, : frames.n_robots]
    working: npt.NDArray[np.bool_] = alive & ~frames.crashed
    return working


def _fallen(frames: Frames) -> npt.NDArray[np.bool_]:
    """(T, n) robots that live and are crashed"""
    fallen: npt.NDArray[np.bool_] = frames.alive[:-1, : frames.n_robots] & frames.crashed
    return fallen


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else float("nan")


def _distances(frames: Frames, others: Sequence[int]) -> Floats:
    """(T, n, m) metres from each robot to each of ``others``"""
    at = frames.positions_m[:-1].astype(np.float64)
    offsets = at[:, : frames.n_robots, None] - at[:, None, list(others)]
    distances: Floats = np.linalg.norm(offsets, axis=-1)
    return distances


def focus(frames: Frames) -> float:
    """Of the working robots that hit in a step, the share that hit the target most of them hit.

    Mean over the steps in which at least two hit.
    """
    opponents = frames.indexes(Side.OPPONENTS)
    struck = frames.damage[:, opponents, : frames.n_robots] > 0
    struck = struck & _working(frames)[:, None]
    hitting = struck.any(axis=1).sum(axis=1)
    together = hitting >= 2
    if not together.any():
        return float("nan")
    most = struck.sum(axis=2).max(axis=1)
    return float((most[together] / hitting[together]).mean())


def opponent_distance(frames: Frames) -> float:
    """From a working robot to the nearest living opponent, mean over robots and steps."""
    opponents = frames.indexes(Side.OPPONENTS)
    if not opponents:
        return float("nan")
    living = frames.alive[:-1][:, opponents]
    distances = np.where(living[:, None], _distances(frames, opponents), np.inf).min(axis=2)
    return _mean(distances[_working(frames) & np.isfinite(distances)])


def spread(frames: Frames) -> float:
    """Root mean square distance of the working robots from their centre, mean over steps."""
    working = _working(frames)
    found = [
        float(np.sqrt(((at[who] - at[who].mean(axis=0)) ** 2).sum(axis=1).mean()))
        for at, who in zip(frames.positions_m[:-1, : frames.n_robots], working, strict=True)
        if who.sum() >= 2
    ]
    return _mean(np.array(found))


def crashed_distance(frames: Frames) -> float:
    """From a working robot to the nearest living crashed one, mean over robots and steps."""
    distances = _to_fallen(frames)
    return _mean(distances[_working(frames) & np.isfinite(distances)])


def crashed_life(frames: Frames) -> float:
    """How long a crashed robot lives, mean over the crashed ones; to the end where it survives."""
    fallen = list(frames.faulted)
    if not fallen:
        return float("nan")
    return float(frames.alive[:-1][:, fallen].sum(axis=0).mean()) * frames.dt_s


def neighbour_damage(frames: Frames) -> float:
    """What the NEAREST working robots to a crashed one lose per second and robot."""
    return _damage_rate(frames, near=True)


def other_damage(frames: Frames) -> float:
    """What the working robots further away lose per second and robot, in the same steps."""
    return _damage_rate(frames, near=False)


def _to_fallen(frames: Frames) -> Floats:
    """(T, n) metres to the nearest living crashed robot; infinite where there is none"""
    distances = _distances(frames, range(frames.n_robots))
    nearest: Floats = np.where(_fallen(frames)[:, None], distances, np.inf).min(axis=2)
    return nearest


def _damage_rate(frames: Frames, near: bool) -> float:
    if not frames.indexes(Side.OPPONENTS):
        return float("nan")
    working, distances = _working(frames), _to_fallen(frames)
    beside = np.where(working & np.isfinite(distances), distances, np.inf)
    rank = beside.argsort(axis=1, kind="stable").argsort(axis=1, kind="stable")
    chosen = np.isfinite(beside) & ((rank < NEAREST) if near else (rank >= NEAREST))
    taken = frames.damage[:, : frames.n_robots].sum(axis=2).astype(np.float64)
    return _mean(taken[chosen]) / frames.dt_s


MEASURES = (
    Measure("focus", "share", "of the robots that hit in a step, on one target", focus),
    Measure("opponent distance", "m", "to the nearest opponent", opponent_distance),
    Measure("spread", "m", "of the working robots about their centre", spread),
    Measure("crashed distance", "m", "to the nearest crashed robot", crashed_distance),
    Measure("crashed life", "s", "until a crashed robot is destroyed", crashed_life),
    Measure("neighbour damage", "points/s", "of the two next to a crashed robot", neighbour_damage),
    Measure("other damage", "points/s", "of the working robots further away", other_damage),
)


def measured(frames: Frames) -> dict[str, float]:
    """Each measure of one episode."""
    return {measure.name: measure.of(frames) for measure in MEASURES}


def averaged(episodes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Each measure's mean over the episodes that have it; NaN where none has."""
    out = {}
    for measure in MEASURES:
        values = np.array([episode[measure.name] for episode in episodes])
        out[measure.name] = _mean(values[~np.isnan(values)])
    return out


@dataclass(frozen=True)
class Behaviour:
    """A measure of one method on one map; of each seed its mean over episodes.

    ``interval``: over seeds, Student's t, 95 %; None with a single one. ``difference``: to the
    first method, paired by seed, with ``p`` corrected by Holm over the map's measures; None for
    that method itself and with fewer than two seeds in common.
    """

    scenario: str
    method: str
    measure: str
    unit: str
    seeds: tuple[int, ...]
    values: tuple[float, ...]
    interval: Estimate | None
    difference: Estimate | None = None
    p: float | None = None


def compare(found: Sequence[tuple[Run, Mapping[str, float]]]) -> list[Behaviour]:
    """Per map, measure and method. What no run of a map has is left out."""
    out: list[Behaviour] = []
    for scenario in dict.fromkeys(run.scenario for run, _ in found):
        here = [(run, values) for run, values in found if run.scenario == scenario]
        methods = list(dict.fromkeys(run.method for run, _ in here))
        rows = [row for measure in MEASURES for row in _rows_of(scenario, measure, methods, here)]
        corrected = iter(holm([row.p for row in rows if row.p is not None]))
        out += [row if row.p is None else replace(row, p=next(corrected)) for row in rows]
    return out


def _rows_of(
    scenario: str,
    measure: Measure,
    methods: Sequence[str],
    found: Sequence[tuple[Run, Mapping[str, float]]],
) -> list[Behaviour]:
    """A row per method that has the measure, its p not corrected."""
    by: dict[str, dict[int, float]] = {method: {} for method in methods}
    for run, values in found:
        if not np.isnan(values[measure.name]):
            by[run.method][run.seed] = values[measure.name]
    first = by[methods[0]]
    rows = []
    for method, of_seeds in by.items():
        if not of_seeds:
            continue
        row = _row(scenario, method, measure, of_seeds)
        common = [seed for seed in of_seeds if seed in first]
        if method != methods[0] and len(common) >= LEAST_SEEDS:
            apart = np.array([of_seeds[seed] - first[seed] for seed in common])
            row = replace(row, difference=mean_interval(apart), p=paired_p_value(apart))
        rows.append(row)
    return rows


def _row(scenario: str, method: str, measure: Measure, of_seeds: Mapping[int, float]) -> Behaviour:
    values = np.array(list(of_seeds.values()))
    interval = mean_interval(values) if len(values) >= LEAST_SEEDS else None
    place = (scenario, method, measure.name, measure.unit)
    return Behaviour(*place, tuple(of_seeds), tuple(values.tolist()), interval)
