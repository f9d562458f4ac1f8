"""The verb `console`, which is also the package's executable."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from crash_coach_common.contract import UserError
from crash_coach_console.access import Access
from crash_coach_console.serve import PORT, serve
from crash_coach_console.source import Source


def console(
    domain: Annotated[
        list[int] | None,
        typer.Option(help="ROS domain of a graph; two of them stand side by side.", min=0, max=232),
    ] = None,
    namespace: Annotated[str, typer.Option(help="Namespace of the graphs.")] = "",
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
    """Shows a running team as a web page: look, click a robot, crash it, read what it costs."""
    access = Access(host, token)
    # Imported here: no other verb should wait for ROS.
    from crash_coach_console.ros.graph_source import GraphSource

    domains: list[int | None] = list(domain) if domain else [None]
    sources: list[Source] = [
        GraphSource(i, "", number, namespace, end_faults) for i, number in enumerate(domains)
    ]
    serve(sources, access, port, lambda url: typer.echo(f"console: {url}"))


def main() -> None:
    """Of ``ros2 run crash_coach_console console``."""
    try:
        typer.run(console)
    except UserError as error:
        print(f"console: error: {error}", file=sys.stderr)  # noqa: T201
        sys.exit(1)
