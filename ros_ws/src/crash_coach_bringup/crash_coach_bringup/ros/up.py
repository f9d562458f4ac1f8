"""``crash-coach up``: the graph under supervision until it ends, dies or is interrupted."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from crash_coach_bringup.ros.episodes import listening, summary_lines
from crash_coach_bringup.ros.graph import (
    GraphError,
    Process,
    UpOptions,
    check_team,
    domain_id,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.namespaces import checked_namespace
from crash_coach_bringup.ros.supervisor import Event, Supervisor, watch
from crash_coach_console.access import Access
from crash_coach_console.episodes import Played
from crash_coach_console.serve import check_address, page_url
from sim_pkg.ros.sim_lock import SecondSimError, only_sim

CONSOLE = "console"


def run_up(
    options: UpOptions, on_event: Callable[[Event], None], console: int | None = None
) -> int:
    """Runs the graph; returns the exit code: 0 after the last episode, 1 after a death, 130.

    ``console``: port on which its page is served meanwhile; the graph goes on without it.

    ``on_event`` hears what happens as it happens. Call it from the main thread: SIGINT,
    SIGTERM and SIGHUP stop the graph in order while it runs.

    Raises:
        GraphError: a checkpoint that does not fit, a missing executable, a bad domain, or a
            sim that already runs on the domain.
        ConfigError, CheckpointError: as check_team.
        OSError: a log cannot be written.
    """
    domain = domain_id(options)
    processes = graph_processes(options, check_team(options))
    if console is not None:
        processes.append(console_process(console, options.namespace))
    refuse_second_sim(domain, options.namespace)
    environment, lockstep = graph_environment(domain), options.mode == "lockstep"
    with (
        stop_signals() as interrupted,
        Supervisor(processes, options.log_dir, environment, throughput=lockstep) as running,
        # Within: its node leaves before the others do. While five of them left it died once.
        listening(domain, options.namespace) as episodes,
    ):

        def tell(found: Iterable[Played]) -> None:
            for played in found:
                on_event(Event("episode", "", str(played)))

        for name, pid in running.pids().items():
            on_event(Event("started", name, f"process {pid}, log {running.log_of(name)}"))
        if console is not None:
            on_event(Event("started", CONSOLE, page_url(Access(), console)))
        exit_code = watch(
            running,
            ("sim", "graph"),
            interrupted,
            on_event,
            meanwhile=lambda: tell(episodes.told()),
            companions=(CONSOLE,),
        )
        tell(episodes.rest())
    for line in summary_lines(episodes.costs):
        on_event(Event("summary", "", line))
    on_event(Event("stopped", "", f"no process is left on domain {domain}"))
    return exit_code


def console_process(port: int, namespace: str) -> Process:
    """Of a graph in ``namespace``. Raises UserError where the port is taken."""
    check_address(Access().host, port)
    arguments = ["-m", "crash_coach_console.command", "--port", str(port)]
    if namespace:
        arguments += ["--namespace", checked_namespace(namespace)]
    return Process(CONSOLE, (sys.executable, *arguments))


def refuse_second_sim(domain: int, namespace: str) -> None:
    """Raises GraphError where a sim already runs on the domain, in the namespace."""
    try:
        with only_sim(domain, checked_namespace(namespace)):
            pass  # it is free: the graph's own sim takes it
    except SecondSimError as error:
        raise GraphError(str(error)) from None


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Turns SIGINT, SIGTERM and SIGHUP into a flag, so that stopping is never cut short."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
