"""Pictures of evaluations: what each team did in its first episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from policy_pkg.checkpoint import PolicyBundle
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation, record
from sim_pkg.render.comparison import Panel, Track, draw_trajectories


@dataclass(frozen=True)
class TeamResults:
    """What a trained team did under each condition."""

    label: str
    colour: str
    bundle: PolicyBundle
    results: Sequence[tuple[Condition, Evaluation]]


def draw_first_episodes(teams: Sequence[TeamResults], scenario: str, path: Path) -> None:
    """One panel per condition, with every team's trajectories in its colour.

    All teams have the same conditions, in one order. The episodes are played again to be drawn.

    Raises:
        RuntimeError: an episode that was played again is not the one that was evaluated.
    """
    panels = []
    for index, (condition, _) in enumerate(teams[0].results):
        tracks = []
        for team in teams:
            condition, evaluation = team.results[index]
            first = evaluation.episodes[0]
            one = range(first.episode, first.episode + 1)
            (frames,) = record(team.bundle, scenario, condition, one, evaluation.seed)
            if frames.trajectory_hash != first.trajectory_hash:
                raise RuntimeError(
                    f"{team.label}, {condition.name}: episode {first.episode} has trajectory "
                    f"hash {first.trajectory_hash}, played again {frames.trajectory_hash}"
                )
            tracks.append(Track(team.label, team.colour, frames))
        panels.append(Panel(condition.name, tracks))
    draw_trajectories(panels, path)
