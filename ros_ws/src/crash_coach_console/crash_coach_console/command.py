"""The verb `console`, which is also the package's executable."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from crash_coach_common.contract import UserError
from crash_coach_console.access import Access
from crash_coach_console.serve import PORT, serve
from crash_coach_console.source import Source


def console(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[WHAT]...",
            help="Instead of graphs: recordings, runs or checkpoints (RUN@best: its best one), or "
            "scripted:NAME.",
        ),
    ] = None,
    domain: Annotated[
        list[int] | None,
        typer.Option(help="ROS domain of a graph; two of them stand side by side.", min=0, max=232),
    ] = None,
    namespace: Annotated[str, typer.Option(help="Namespace of the graphs.")] = "",
    scenario: Annotated[
        str | None,
        typer.Option(help="Scenario name or YAML file of what is shown; default: its own."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the episodes that a run plays.", min=0)] = 0,
    port: Annotated[
        int, typer.Option(help="Port of the page; 0: any free one.", min=0, max=65535)
    ] = PORT,
    host: Annotated[
        str, typer.Option(help="Address to listen on; another than this machine's needs --token.")
    ] = "127.0.0.1",
    token: Annotated[
        str, typer.Option(help="What a browser must know, 16 characters or more.")
    ] = "",
    end_faults: Annotated[
        bool, typer.Option("--end-faults", help="Every fault ends with the console.")
    ] = False,
) -> None:
    """Shows a team as a web page: look, click a robot, crash it, read what it costs.

    Without WHAT, the graph that runs on the domain. A run or a checkpoint plays episodes here,
    without ROS, and a run shows its curves; a recording is played as it was.
    """
    access = Access(host, token)
    if what and (domain or namespace or end_faults):
        raise UserError(f"{what[0]}: --domain, --namespace and --end-faults are a graph's")
    if what:
        sources = [shown(i, name, scenario, seed) for i, name in enumerate(what)]
    else:
        sources = graphs(domain or [None], namespace, end_faults)
    serve(sources, access, port, tell_address)


def tell_address(url: str) -> None:
    # Whoever closed the pipe wants no line, but the page can be wanted all the same.
    with suppress(BrokenPipeError):
        typer.echo(f"console: {url}")


def graphs(domains: Sequence[int | None], namespace: str, end_faults: bool) -> list[Source]:
    """Imports ROS, which no other verb and no recording should wait for."""
    from crash_coach_console.ros.graph_source import GraphSource

    return [GraphSource(i, "", number, namespace, end_faults) for i, number in enumerate(domains)]


def shown(number: int, name: str, scenario: str | None, seed: int) -> Source:
    """What the command line names.

    Raises:
        UserError: it is not there, damaged, or its scenario is not known.
    """
    from crash_coach_console.episode_source import EpisodeSource
    from crash_coach_console.player import Player
    from crash_coach_console.recording import Recording
    from crash_coach_console.run_source import RunSource
    from policy_pkg.bags.bag import is_recording
    from policy_pkg.play.target import load_target
    from policy_pkg.report.finished_runs import has_begun
    from policy_pkg.team_name import scripted_name
    from policy_pkg.train.run_dir import RUN

    path = Path(name)
    if scripted_name(name) is None:
        if is_recording(path):
            return EpisodeSource(number, Recording(path, scenario))
        if (path / RUN).is_file() and not has_begun(path):
            return RunSource(number, path)
    return EpisodeSource(number, Player(load_target(name, scenario), seed))


def main() -> None:
    """Of ``ros2 run crash_coach_console console``."""
    try:
        typer.run(console)
    except UserError as error:
        print(f"console: error: {error}", file=sys.stderr)  # noqa: T201
        sys.exit(1)


if __name__ == "__main__":
    main()
