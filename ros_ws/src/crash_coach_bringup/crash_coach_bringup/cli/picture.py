"""Pictures of evaluations: what each team did in its first episode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from policy_pkg.train.evaluate import Condition, Evaluation
from sim_pkg.env import make_env
from sim_pkg.render import Track, TrajectoryPanel, draw_trajectories

Evaluations = list[tuple[Condition, Evaluation]]


def draw_first_episodes(
    teams: Mapping[str, tuple[str, Evaluations]], scenario: str, path: Path
) -> None:
    """One panel per condition, with every team's trajectories in its colour.

    teams: label -> (colour, evaluations); all teams under the same conditions, in one order,
    evaluated with positions.
    """
    scene = make_env(scenario, 1).scene
    names = [condition.name for condition, _ in next(iter(teams.values()))[1]]
    panels = []
    for index, name in enumerate(names):
        tracks = []
        for label, (colour, evaluations) in teams.items():
            episode = evaluations[index][1].episodes[0]
            assert episode.positions_m is not None  # evaluated with positions
            tracks.append(Track(label, colour, episode.positions_m, episode.crashed))
        panels.append(
            TrajectoryPanel(
                name,
                scene.arena_m,
                scene.sites_m,
                tracks,
                grid=scene.cell_m > 0,
                cell_m=scene.cell_m,
            )
        )
    draw_trajectories(panels, path)
