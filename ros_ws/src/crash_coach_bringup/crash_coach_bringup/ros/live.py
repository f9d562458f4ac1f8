"""``crash-coach train-live``: graphs and the trainer that they play for, under supervision."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crash_coach_bringup.ros.discovery import VARIABLE
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    PATIENT_LEASE_S,
    Layout,
    Mode,
    Node,
    Process,
    UpOptions,
    Value,
    check_team,
    graph_environment,
    graph_processes,
    node_process,
    relays_observations,
)
from crash_coach_bringup.ros.supervisor import Event, Supervisor, watch
from crash_coach_bringup.ros.up import stop_signals
from policy_pkg.checkpoint import CHECKPOINTS, list_checkpoints, read_manifest
from policy_pkg.ros.recorder_node import PROFILE
from policy_pkg.train.config import TrainConfig, graph_seed, load_train_config

TRAINER = "trainer"
MATCH_S = 120.0  # the policies are there once the trainer has given them weights


@dataclass(frozen=True)
class LiveOptions:
    """A run: its configuration, its directory, and how its ``n_envs`` graphs run.

    ``sim``: further parameters of the sims. ``log_dir`` None: ``<out>.logs``.
    """

    config: str
    out: Path
    overrides: tuple[str, ...] = ()
    seed: int | None = None
    resume: bool = False
    mode: Mode = "lockstep"
    layout: Layout = "single"
    sim: dict[str, Value] | None = None
    log_dir: Path | None = None


def run_live(
    options: LiveOptions, on_event: Callable[[Event], None], on_line: Callable[[str], None]
) -> int:
    """Runs graphs and trainer; returns the exit code: 0 when trained, 1 after a death, 130.

    ``on_event`` hears of processes, ``on_line`` what the trainer says. Call it from the main
    thread: SIGINT, SIGTERM and SIGHUP stop everything in order.

    Raises:
        UserError: the configuration is wrong, an executable is missing, no domain is free.
        OSError: a log cannot be written.
    """
    config = load_train_config(options.config, options.overrides, options.seed)
    log_dir = options.log_dir or options.out.with_name(f"{options.out.name}.logs")
    with ExitStack() as held:
        domains = [held.enter_context(reserve_domain()) for _ in range(config.n_envs)]
        processes = live_processes(options, config, domains)
        interrupted = held.enter_context(stop_signals())
        throughput = options.mode == "lockstep"
        running = held.enter_context(
            Supervisor(processes, log_dir, graph_environment(domains[0]), throughput)
        )
        for name, pid in running.pids().items():
            on_event(Event("started", name, f"process {pid}, log {running.log_of(name)}"))
        with new_lines(running.log_of(TRAINER)) as lines:

            def poll() -> bool:
                for line in lines():
                    on_line(line)
                return interrupted()

            exit_code = watch(running, (TRAINER,), poll, on_event)
            poll()
    on_event(Event("stopped", "", "no process is left"))
    return exit_code


def live_processes(options: LiveOptions, config: TrainConfig, domains: list[int]) -> list[Process]:
    """The trainer's and every graph's, each on its domain. Raises UserError as graph_processes."""
    first = next_episodes(options, config)
    processes = [trainer_process(options, config, domains)]
    for index, domain in enumerate(domains):
        graph = graph_options(options, config, index, domain, first[index])
        for process in graph_processes(graph, check_team(graph)):
            name = process.name if len(domains) == 1 else f"{process.name}_{index + 1}"
            argv = ("env", f"ROS_DOMAIN_ID={domain}", *process.argv)
            processes.append(Process(name, argv))
    return processes


def graph_options(
    options: LiveOptions, config: TrainConfig, index: int, domain: int, first_episode: int
) -> UpOptions:
    """The ``index``-th graph, whose episodes begin with ``first_episode``."""
    sim = {"match_timeout_s": MATCH_S, "first_episode": first_episode, **(options.sim or {})}
    return UpOptions(
        scenario=config.scenario,
        checkpoint=None,
        mode=options.mode,
        layout=options.layout,
        seed=graph_seed(config.seed, index),
        autostart=options.mode == "realtime",
        coach=config.coach,
        sim=sim,
        domain=domain,
        lease_s=PATIENT_LEASE_S if options.mode == "lockstep" else None,
    )


def trainer_process(options: LiveOptions, config: TrainConfig, domains: list[int]) -> Process:
    graph = graph_options(options, config, 0, domains[0], 0)
    parameters: dict[str, Value] = {
        "config": options.config,
        "out": str(options.out.resolve()),
        "overrides": list(options.overrides) or ["none"],
        "seed": config.seed,
        "resume": options.resume,
        "mode": options.mode,
        "domains": domains,
        "observation_topic": "observation_seen" if relays_observations(graph) else "observation",
    }
    process = node_process(Node(TRAINER, "policy_pkg", "trainer", parameters))
    # Deep queues for what comes while it learns.
    return Process(process.name, ("env", f"{VARIABLE}={PROFILE}", *process.argv))


def next_episodes(options: LiveOptions, config: TrainConfig) -> list[int]:
    """Where the sims go on when a run is resumed: then it is as if it had never stopped."""
    found = list_checkpoints(options.out / CHECKPOINTS) if options.resume else []
    if not found:
        return [0] * config.n_envs
    training: dict[str, Any] = read_manifest(found[-1]).training
    numbers = training.get("next_episodes", [])
    return [int(number) for number in numbers] + [0] * (config.n_envs - len(numbers))


@contextmanager
def new_lines(path: Path) -> Iterator[Callable[[], list[str]]]:
    """Yields what returns the lines that were added to a file since it was last asked."""
    with path.open(encoding="utf-8", errors="replace") as file:
        rest = ""

        def lines() -> list[str]:
            nonlocal rest
            *whole, rest = (rest + file.read()).split("\n")
            return whole

        yield lines
