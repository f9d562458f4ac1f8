"""Two small teams in real time, a console on one and on both, and one browser for all tests."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest
from crash_coach_interfaces.msg import EpisodeState
from std_srvs.srv import Trigger

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    UpOptions,
    check_team,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

if TYPE_CHECKING:
    from playwright.sync_api import Browser

WAIT_S = 20.0
SCENARIO = "buttons"


@contextmanager
def console(environment: dict[str, str], *options: str) -> Iterator[str]:
    """A console of its own process; yields the page's address."""
    command = [sys.executable, "-m", "crash_coach_bringup.cli.main", "console", "--port", "0"]
    child = subprocess.Popen(
        [*command, *options],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert child.stdout is not None
        line = child.stdout.readline()
        assert line.startswith("console: http://"), line
        yield line.removeprefix("console: ").strip()
    finally:
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=WAIT_S) == 0


@dataclass(frozen=True)
class Teams:
    """``clients`` listen to the graphs as anybody could."""

    domains: tuple[int, int]
    clients: tuple[GraphClient, GraphClient]
    crashed: dict[tuple[int, int], list[int]]  # of the first team, by (episode, step)
    one: str  # address of the console on the first team
    both: str

    def crashed_at(self, episode: int, step: int) -> list[int]:
        """Who of the first team was crashed in a control step, once it is over."""
        key = (episode, step)
        self.clients[0].until(lambda: key in self.crashed, WAIT_S, f"episode, step {key}")
        return self.crashed[key]

    def clear(self) -> None:
        """Ends every fault of both."""
        for client in self.clients:
            service = client.node.create_client(Trigger, "/coach/clear_all")
            client.until(service.service_is_ready, WAIT_S, "a coach")
            client.greet("/coach", WAIT_S, "a coach")
            answer = client.result(service.call_async(Trigger.Request()), WAIT_S, "its answer")
            assert answer.success, answer.message
            client.node.destroy_client(service)


@pytest.fixture(scope="session")
def teams(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Teams]:
    folder = tmp_path_factory.mktemp("console")
    checkpoint = folder / "step_0"
    write_untrained(checkpoint, make_env(SCENARIO, 1).spec, seed=1)
    options = UpOptions(
        SCENARIO,
        checkpoint,
        mode="realtime",
        layout="single",
        epsilon=1.0,  # so that they move
        sim={"real_time_factor": 2.0},
    )
    processes = graph_processes(options, check_team(options))
    with ExitStack() as stack:
        domains, clients = [], []
        for name in ("plain", "coached"):
            domain = stack.enter_context(reserve_domain())
            environment = graph_environment(domain)
            stack.enter_context(Supervisor(processes, folder / name, environment))
            domains.append(domain)
        for domain in domains:
            clients.append(stack.enter_context(graph_client("looker", domain)))
        first, second = domains
        crashed: dict[tuple[int, int], list[int]] = {}

        def look(state: EpisodeState) -> None:
            crashed[state.episode, state.step - 1] = list(state.crashed)

        clients[0].node.create_subscription(EpisodeState, "/sim/episode", look, 1000)
        environment = {**os.environ, **graph_environment(first)}
        one = stack.enter_context(console(environment))
        asked = ("--domain", str(first), str(second))
        both = stack.enter_context(console(environment, *asked))
        yield Teams((first, second), (clients[0], clients[1]), crashed, one, both)


def chromium() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    program = chromium()
    if program is None:
        pytest.skip("no chromium on PATH: apt-get install chromium (as .ci/run does)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        running = playwright.chromium.launch(
            executable_path=program,
            args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"],
        )
        yield running
        running.close()
