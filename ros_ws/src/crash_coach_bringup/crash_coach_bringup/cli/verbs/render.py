"""`crash-coach render`: an episode, played or recorded, as a film or a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crash_coach_bringup.cli.options import (
    MODE,
    ModeOption,
    ParamOption,
    conditions,
    mode_parameters,
)
from crash_coach_bringup.cli.output import (
    CliError,
    check_file_target,
    check_json_target,
    console,
    not_written,
    tell_note,
    written_first,
)
from crash_coach_common.strict_yaml import ConfigError
from policy_pkg.bags.bag import is_recording
from policy_pkg.bags.playback import play_back, read_episode
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import evaluation_seed, record, record_pictures
from policy_pkg.play.target import HELP, Target, load_target
from sim_pkg.render.frames import Frames
from sim_pkg.scenario_source import ScenarioSource, read_scenario

if TYPE_CHECKING:
    from sim_pkg.foreign.pictures import Pictures

FILMS, STILLS = (".mp4", ".gif"), (".png",)
OF_A_TEAM = ("seed", "crash_rate", "crashed", "victims", "mode", "param")


def check_out(out: Path) -> None:
    """As ``check_file_target``.

    Raises:
        CliError: also for another suffix.
    """
    if out.suffix not in FILMS + STILLS:
        raise CliError(f"--out {out}: a file ending in {', '.join(FILMS + STILLS)} is needed")
    check_file_target("--out", out)


def draw(frames: Frames | Pictures, out: Path, speed: float, caption: str) -> None:
    """Writes the episode to ``out``; ``caption``: who acts, and what happens to whom.

    Raises:
        CliError: the file cannot be written.
    """
    # Imported here: no other verb should wait for matplotlib.
    from sim_pkg.foreign.pictures import Pictures, write_still
    from sim_pkg.render.film import write_video
    from sim_pkg.render.still import draw_still

    try:
        if out.suffix not in STILLS:
            write_video(frames, out, speed, caption)
        elif isinstance(frames, Pictures):
            write_still(frames, out)
        else:
            draw_still(frames, out, caption)
    except OSError as error:
        raise CliError(not_written("--out", out, error)) from None
    console.print(f"wrote {out}", markup=False, highlight=False, soft_wrap=True)


def outcome(frames: Frames | Pictures) -> dict[str, Any]:
    """JSON values: which episode it is, and how it ended."""
    return {
        "scenario": frames.scenario,
        "seed": frames.seed,
        "episode": frames.episode,
        "crashed": list(frames.faulted),
        "success": frames.success,
        "steps": frames.steps,
        "episode_return": float(frames.returns[-1]),
        "trajectory_hash": frames.trajectory_hash,
    }


def tell(frames: Frames | Pictures) -> None:
    who = ", ".join(frames.robots[i] for i in frames.faulted) or "nobody"
    done = "success" if frames.success else "no success"
    if frames.success is None:
        done = "ended"
    told = f"episode {frames.episode}: {done} after {frames.steps} steps; crashed: {who}"
    console.print(told, highlight=False)


def recorded(name: str, episode: int | None, scenario: str | None) -> tuple[Frames, dict[str, Any]]:
    """A recorded episode played again, and JSON values of what was recorded.

    Raises:
        BagError: no such recording or episode.
        CliError: the scenario is not told, or not known here.
        UserError: it gives another trajectory here.
    """
    found, about = read_episode(Path(name), episode)
    told = about.scenario if about is not None else ""
    chosen = scenario or told
    if not chosen:
        raise CliError(f"{name}: the recording does not name its scenario: --scenario is needed")
    try:
        frames = play_back(found, chosen)
    except ConfigError as error:
        if scenario is not None:
            raise
        raise CliError(
            f"{name}: recorded with a scenario that is not here ({error}); --scenario FILE names it"
        ) from None
    return frames, {"recording": name, "modes": sorted(set(found.modes.values()))}


def render(
    context: typer.Context,
    team: Annotated[str, typer.Argument(metavar="TEAM", help=f"{HELP[:-1]}; or a recording.")],
    out: Annotated[Path, typer.Option(help="A .mp4 or .gif film, or a .png picture.")],
    scenario: Annotated[
        str | None,
        typer.Option(help="Scenario name or YAML file; default: the trained team's, the recorded."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed, as of evaluate.", min=0)] = 0,
    episode: Annotated[
        int | None,
        typer.Option(
            help="Its number; default: 0, of a recording the first that is complete.",
            min=0,
            max=2**32 - 1,
        ),
    ] = None,
    crash_rate: Annotated[
        float | None, typer.Option(help="Each robot crashes with this probability.")
    ] = None,
    crashed: Annotated[int | None, typer.Option(help="So many robots crash, drawn.")] = None,
    victims: Annotated[list[str] | None, typer.Option(help="ROBOT ...: these robots.")] = None,
    mode: ModeOption = MODE,
    param: ParamOption = None,
    speed: Annotated[float, typer.Option(help="Of a film, times real time.")] = 1.0,
    json: Annotated[Path | None, typer.Option(help="Also write what happened here.")] = None,
) -> None:
    """Draws an episode: of a team the one that evaluate plays, of a recording the one recorded.

    Needs no display. A recorded episode is played again from its seed and the actions that were
    executed, and drawn only where that gives the recorded trajectory, bit for bit.
    """
    check_json_target(json)
    check_out(out)
    if not 0.01 <= speed <= 1000:
        raise CliError(f"--speed {speed}: 0.01 to 1000 times real time")
    if is_recording(Path(team)):
        refuse_options_of_a_team(context)
        frames: Frames | Pictures
        frames, which = recorded(team, episode, scenario)
    else:
        parameters = mode_parameters(mode, param or [])
        target = load_target(team, scenario)
        condition = one_condition(target.robots, crash_rate, crashed, victims, mode, parameters)
        frames = play_one(target, condition, episode or 0, seed)
        crash = condition.crash.model_dump(mode="json")
        which = {"team": team, "condition": condition.name, "crash": crash, "seed": seed}
    with written_first(json, {**outcome(frames), **which, "file": str(out)}):
        tell(frames)
        draw(frames, out, speed, caption_of(which))


def play_one(target: Target, condition: Condition, episode: int, seed: int) -> Frames | Pictures:
    """An episode that evaluate plays too, as what can be drawn of it."""
    key = evaluation_seed(seed)
    tell_note(target.note)
    source = target.source
    source = source if isinstance(source, ScenarioSource) else read_scenario(source)
    if source.foreign() is not None:
        return replace(record_pictures(target.team, source, condition, episode, key), seed=seed)
    (frames,) = record(target.team, source, condition, range(episode, episode + 1), key)
    return replace(frames, seed=seed)


def caption_of(which: Mapping[str, Any]) -> str:
    """'runs/mine: robot_2 random', of a recording its name and the modes in it."""
    if "team" in which:
        return f"{which['team']}: {which['condition']}"
    return ": ".join([which["recording"], ", ".join(which["modes"]) or "crash-free"])


def refuse_options_of_a_team(context: typer.Context) -> None:
    """Raises CliError for what a recording has settled."""
    for name in OF_A_TEAM:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            option = name.replace("_", "-")
            raise CliError(f"--{option} has no meaning with a recording: it says who crashed how")


def one_condition(
    robots: tuple[str, ...],
    crash_rate: float | None,
    crashed: int | None,
    victims: list[str] | None,
    mode: str,
    parameters: Mapping[str, float],
) -> Condition:
    """Raises CliError where more than one is asked for."""
    rates = [] if crash_rate is None else [crash_rate]
    counts = [] if crashed is None else [crashed]
    asked = conditions(robots, rates, counts, victims or [], mode, parameters)
    if len(asked) > 1:
        raise CliError("--crash-rate, --crashed, --victims: an episode is played under one of them")
    return asked[0]
