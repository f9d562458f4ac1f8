"""`crash-coach calibrate`: what the scripted policies achieve, beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.options import (
    MODE,
    MOST_EPISODES,
    CrashedOption,
    ModeOption,
    ParamOption,
    conditions,
    mode_parameters,
)
from crash_coach_bringup.cli.output import (
    CliError,
    check_json_target,
    console,
    percent_ci,
    table,
    written_first,
)
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Scripted, evaluation_seed, record
from policy_pkg.statistics import wilson
from sim_pkg.env import make_env
from sim_pkg.open_loop import Search, play, search
from sim_pkg.render.frames import Frames, Side
from sim_pkg.scripted import make_scripted, scripted_names

OPEN_LOOP = {"open loop, what it can do": True, "open loop": False}  # whether it knows the mask
AT_ONCE = 256  # episodes that are kept before they are counted; about 100 kB each


@dataclass
class Tally:
    """Sums over episodes: what is left of each of them."""

    episodes: int = 0
    wins: int = 0
    steps: int = 0
    robots_lost: int = 0
    opponents_lost: int = 0
    episode_return: float = 0.0
    courses: set[bytes] = field(default_factory=set)
    drawn: bool = True  # whether the condition draws victims or effects

    def count(self, frames: Frames) -> None:
        dead = ~frames.alive[-1]
        self.episodes += 1
        self.wins += frames.success
        self.steps += frames.steps
        self.robots_lost += int(dead[frames.indexes(Side.ROBOTS)].sum())
        self.opponents_lost += int(dead[frames.indexes(Side.OPPONENTS)].sum())
        self.episode_return += float(frames.returns[-1])
        seen = (frames.positions_m, frames.angles_rad, frames.health, frames.returns)
        self.courses.add(b"".join(array.tobytes() for array in seen))

    def figures(self) -> dict[str, Any]:
        """JSON values: win rate with its Wilson interval, mean length, who was lost on average."""
        interval = wilson(self.wins, self.episodes)
        alike = len(self.courses) == 1 < self.episodes and not self.drawn
        return {
            "success_rate": self.wins / self.episodes,
            "success_ci95": None if alike else [interval.low, interval.high],
            "alike": alike,
            "steps_mean": self.steps / self.episodes,
            "robots_lost_mean": self.robots_lost / self.episodes,
            "opponents_lost_mean": self.opponents_lost / self.episodes,
            "return_mean": self.episode_return / self.episodes,
        }


def tally(policy: str, scenario: str, condition: Condition, episodes: int, seed: int) -> Tally:
    """Plays episodes 0 .. ``episodes`` - 1, at most AT_ONCE of them in memory."""
    out = Tally(drawn=condition.drawn)
    for first in range(0, episodes, AT_ONCE):
        some = range(first, min(first + AT_ONCE, episodes))
        for frames in record(Scripted(policy), scenario, condition, some, evaluation_seed(seed)):
            out.count(frames)
    return out


def asked_of(
    scenario: str,
    policies: list[str],
    crashed: list[int],
    mode: str,
    parameters: Mapping[str, float],
) -> list[tuple[str, Condition]]:
    """Every policy under every condition.

    Raises:
        CliError: more crashed robots than there are.
        ConfigError: unknown or wrong scenario, or a policy that does not play it.
    """
    env = make_env(scenario, 1)
    names = policies or list(scripted_names(env))
    for name in names:
        make_scripted(name, env)
    under = conditions(env.spec.robots, [], crashed, [], mode, parameters)
    return [(name, condition) for name in names for condition in under]


def rows_of(
    scenario: str, asked: Sequence[tuple[str, Condition]], episodes: int, seed: int
) -> list[dict[str, Any]]:
    """A row per policy and condition."""
    return [
        {
            "scenario": scenario,
            "policy": name,
            "condition": condition.name,
            **tally(name, scenario, condition, episodes, seed).figures(),
        }
        for name, condition in asked
    ]


def show(title: str, rows: Sequence[dict[str, Any]]) -> None:
    out = table(title, ["policy", "crash", "success (95 %)", "steps", "lost own/opp.", "return"])
    for row in rows:
        out.add_row(
            row["policy"],
            row["condition"],
            percent_ci(row["success_rate"], row["success_ci95"]),
            f"{row['steps_mean']:.0f}",
            f"{row['robots_lost_mean']:.1f} / {row['opponents_lost_mean']:.1f}",
            f"{row['return_mean']:.1f}",
        )
    console.print(out)


def open_loop_rows(scenario: str, episodes: int, seed: int) -> list[dict[str, Any]]:
    """A row per kind of open-loop team: the best one found, on episodes that chose none."""
    how = Search()
    env = make_env(scenario, how.arenas)
    rows = []
    for name, masked in OPEN_LOOP.items():
        team = search(env, masked, seed, how)
        score = play(team, env, evaluation_seed(seed), range(episodes))
        interval = wilson(score.wins, score.episodes)
        rows.append(
            {
                "scenario": scenario,
                "policy": name,
                "condition": "crash-free",
                "success_rate": score.wins / score.episodes,
                "success_ci95": [interval.low, interval.high],
                "steps_mean": score.steps_mean,
                "return_mean": score.return_mean,
                "scores": team.scores.tolist(),
            }
        )
    return rows


def show_open_loop(title: str, rows: Sequence[dict[str, Any]]) -> None:
    out = table(title, ["team", "success (95 %)", "steps", "return"])
    for row in rows:
        success = percent_ci(row["success_rate"], row["success_ci95"])
        steps, returns = f"{row['steps_mean']:.0f}", f"{row['return_mean']:.1f}"
        out.add_row(row["policy"], success, steps, returns)
    console.print(out)


def calibrate(
    scenarios: Annotated[
        list[str] | None, typer.Argument(metavar="SCENARIO", help="Scenario names or YAML files.")
    ] = None,
    policy: Annotated[
        list[str] | None, typer.Option(help="NAME ...: these; default: all that play it.")
    ] = None,
    crashed: CrashedOption = None,
    mode: ModeOption = MODE,
    param: ParamOption = None,
    episodes: Annotated[
        int, typer.Option(help="Episodes of each.", min=1, max=MOST_EPISODES)
    ] = 256,
    open_loop: Annotated[
        bool,
        typer.Option(
            "--open-loop",
            help="Instead: the best teams found that see only their names and the time step.",
        ),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of episodes and victims.", min=0)] = 0,
    json: Annotated[Path | None, typer.Option(help="Also write the figures to this file.")] = None,
) -> None:
    """Plays scripted policies: is a scenario as hard as it should be, and winnable at all?"""
    check_json_target(json)
    if not scenarios:
        raise CliError("no scenario: name at least one, such as skirmish/3s_vs_5z")
    # What is wrong is said before anything is played.
    parameters = mode_parameters(mode, param or [])
    if open_loop and (policy or crashed):
        raise CliError("--open-loop searches for teams that work: without --policy and --crashed")
    asked = {
        name: asked_of(name, policy or [], crashed or [], mode, parameters) for name in scenarios
    }
    rows: list[dict[str, Any]] = []
    for scenario, played in asked.items():
        if open_loop:
            rows += open_loop_rows(scenario, episodes, seed)
        else:
            rows += rows_of(scenario, played, episodes, seed)
    how = {"mode": mode, "parameters": parameters}
    with written_first(json, {"seed": seed, "episodes": episodes, **how, "rows": rows}):
        for scenario in asked:
            here = [row for row in rows if row["scenario"] == scenario]
            title = f"{scenario}: {episodes} episodes each, seed {seed}"
            (show_open_loop if open_loop else show)(title, here)
