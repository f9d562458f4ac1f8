"""``crash-coach up``: the graph under supervision until it ends, dies or is interrupted."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from crash_coach_bringup.ros.graph import (
    GraphError,
    UpOptions,
    check_team,
    domain_id,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.supervisor import Event, Supervisor, watch
from sim_pkg.ros.sim_lock import SecondSimError, only_sim


def run_up(options: UpOptions, on_event: Callable[[Event], None]) -> int:
    """Runs the graph; returns the exit code: 0 after the last episode, 1 after a death, 130.

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
    refuse_second_sim(domain)
    environment, lockstep = graph_environment(domain), options.mode == "lockstep"
    with (
        stop_signals() as interrupted,
        Supervisor(processes, options.log_dir, environment, throughput=lockstep) as running,
    ):
        for name, pid in running.pids().items():
            on_event(Event("started", name, f"process {pid}, log {running.log_of(name)}"))
        exit_code = watch(running, ("sim", "graph"), interrupted, on_event)
    on_event(Event("stopped", "", f"no process is left on domain {domain}"))
    return exit_code


def refuse_second_sim(domain: int) -> None:
    """Raises GraphError where a sim already runs on the domain."""
    try:
        with only_sim(domain):
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
