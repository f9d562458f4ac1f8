"""`crash-coach render`: an episode as a film or a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.crash_options import (
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
    write_json,
)
from crash_coach_bringup.cli.target import HELP, load_target
from policy_pkg.train.evaluate import Condition, record
from sim_pkg.frames import Frames

FILMS, STILLS = (".mp4", ".gif"), (".png",)


def check_out(out: Path) -> None:
    """As ``check_file_target``.

    Raises:
        CliError: also for another suffix.
    """
    if out.suffix not in FILMS + STILLS:
        raise CliError(f"--out {out}: a file ending in {', '.join(FILMS + STILLS)} is needed")
    check_file_target("--out", out)


def draw(frames: Frames, out: Path, speed: float) -> None:
    """Writes the episode to ``out``.

    Raises:
        CliError: the file cannot be written.
    """
    # Imported here: no other verb should wait for matplotlib.
    from sim_pkg.render_still import draw_still
    from sim_pkg.render_video import write_video

    try:
        if out.suffix in STILLS:
            draw_still(frames, out)
        else:
            write_video(frames, out, speed)
    except OSError as error:
        raise CliError(f"--out: {out} cannot be written: {error.strerror}") from None


def report(frames: Frames, condition: Condition) -> dict[str, Any]:
    """JSON values: which episode it is, and how it ended."""
    return {
        "scenario": frames.scenario,
        "seed": frames.seed,
        "episode": frames.episode,
        "condition": condition.name,
        "crash": condition.crash.model_dump(mode="json"),
        "crashed": list(frames.faulted),
        "success": frames.success,
        "steps": frames.steps,
        "episode_return": float(frames.returns[-1]),
        "trajectory_hash": frames.trajectory_hash,
    }


def render(
    team: Annotated[str, typer.Argument(metavar="TEAM", help=HELP)],
    out: Annotated[Path, typer.Option(help="A .mp4 or .gif film, or a .png picture.")],
    scenario: Annotated[
        str | None, typer.Option(help="Scenario name or YAML file; default: the trained team's.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed, as of evaluate.", min=0)] = 0,
    episode: Annotated[int, typer.Option(help="Its number.", min=0, max=2**32 - 1)] = 0,
    crash_rate: Annotated[
        float | None, typer.Option(help="Each robot crashes with this probability.")
    ] = None,
    crashed: Annotated[int | None, typer.Option(help="So many robots crash, drawn.")] = None,
    victims: Annotated[list[str] | None, typer.Option(help="ROBOT ...: these robots.")] = None,
    mode: ModeOption = "stay",
    param: ParamOption = None,
    speed: Annotated[float, typer.Option(help="Of a film, times real time.")] = 1.0,
    json: Annotated[Path | None, typer.Option(help="Also write what happened here.")] = None,
) -> None:
    """Draws an episode of a team; the same episode that evaluate plays. Needs no display."""
    check_json_target(json)
    check_out(out)
    if not 0.01 <= speed <= 1000:
        raise CliError(f"--speed {speed}: 0.01 to 1000 times real time")
    parameters = mode_parameters(mode, param or [])
    target = load_target(team, scenario)
    rates = [] if crash_rate is None else [crash_rate]
    counts = [] if crashed is None else [crashed]
    asked = conditions(target.robots, rates, counts, victims or [], mode, parameters)
    if len(asked) > 1:
        raise CliError("--crash-rate, --crashed, --victims: an episode is played under one of them")
    (frames,) = record(target.team, target.scenario, asked[0], range(episode, episode + 1), seed)
    draw(frames, out, speed)
    who = ", ".join(target.robots[i] for i in frames.faulted) or "nobody"
    done = "success" if frames.success else "no success"
    console.print(f"{done} after {frames.steps} steps; crashed: {who}", highlight=False)
    console.print(f"wrote {out}", markup=False, highlight=False, soft_wrap=True)
    write_json(json, {"team": team, **report(frames, asked[0]), "file": str(out)})
