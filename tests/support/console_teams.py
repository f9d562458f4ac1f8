"""Two small teams in real time, a console on one and on both, and one browser for all tests."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import pytest
from bag_maker import Team, write
from bag_maker import messages as messages_of
from crash_coach_interfaces.msg import EpisodeState
from hypothesis import strategies as st
from rcl_interfaces.srv import GetParameters
from std_srvs.srv import Trigger
from websockets.sync.client import ClientConnection, connect

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    UpOptions,
    check_team,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_console.access import Access
from crash_coach_console.episode_source import EpisodeSource
from crash_coach_console.operating import WATCHED
from crash_coach_console.player import Player
from crash_coach_console.recording import Recording
from crash_coach_console.ros.graph_source import read_values
from crash_coach_console.server import Server, make_app
from crash_coach_pkg.coach.parameters import Value
from crash_coach_pkg.faults import mode_names
from policy_pkg.play.target import load_target
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

if TYPE_CHECKING:
    from playwright.sync_api import Browser

WAIT_S = 60.0
SCENARIO = "buttons"


@contextmanager
def console(environment: dict[str, str], *options: str, killed: bool = False) -> Iterator[str]:
    """A console of its own process, which is told to end, or killed; yields the page's address."""
    command = [sys.executable, "-m", "crash_coach_bringup.cli.main", "console", "--port", "0"]
    child = subprocess.Popen(
        [*command, *options],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert child.stdout is not None
    try:
        line = child.stdout.readline()
        assert line.startswith("console: http://"), line
        yield line.removeprefix("console: ").strip()
    finally:
        child.send_signal(signal.SIGKILL if killed else signal.SIGINT)
        assert child.wait(timeout=WAIT_S) == (-signal.SIGKILL if killed else 0)
        child.stdout.close()


@dataclass(frozen=True)
class Teams:
    """``clients`` listen to the graphs as anybody could."""

    domains: tuple[int, int]
    clients: tuple[GraphClient, GraphClient]
    crashed: dict[tuple[int, int], list[int]]  # of the first team, by (episode, step)
    one: str  # address of the console on the first team
    both: str

    def crashed_at(self, episode: int, step: int) -> list[int]:
        """Who of the first team was crashed from a control step on, once that is over.

        A plan that is armed behind an episode's last step is so from the next one's first on. In
        real time a busy machine may lose the commands of a step, and what is lost is not crashed:
        nobody is only where it is nobody in three steps.
        """

        def found() -> list[list[int]]:
            rows = [self.crashed.get((episode, step + later), []) for later in range(3)]
            rows += [self.crashed.get((episode + 1, later), []) for later in range(3)]
            return [row for row in rows if row][:3]

        def clear() -> bool:
            return len(found()) == 3 or any(map(any, found()))

        self.clients[0].until(clear, WAIT_S, f"step {step} of {episode}")
        return next(filter(any, found()), found()[0])

    def newest(self) -> list[int]:
        """Who of the first team was crashed in the last control step."""
        return next(reversed(self.crashed.values()))

    def parameters(self) -> dict[str, Value]:
        """Of the first team's coach, as it has them."""
        client = self.clients[0]
        service = client.node.create_client(GetParameters, "/coach/get_parameters")
        client.greet("/coach", WAIT_S, "a coach")
        request = GetParameters.Request(names=list(WATCHED))
        values = read_values(client.result(service.call_async(request), WAIT_S, "its answer"))
        client.node.destroy_client(service)
        return values

    def clear(self) -> None:
        """Ends every fault of both."""
        for client in self.clients:
            service = client.node.create_client(Trigger, "/coach/clear_all")
            client.until(service.service_is_ready, WAIT_S, "a coach")
            client.greet("/coach", WAIT_S, "a coach")
            answer = client.result(service.call_async(Trigger.Request()), WAIT_S, "its answer")
            assert answer.success, answer.message
            client.node.destroy_client(service)


@pytest.fixture(scope="module")
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
        # Before its first episode a team has no step that a fault could be armed at.
        clients[0].until(lambda: bool(crashed), WAIT_S, "an episode")
        environment = {**os.environ, **graph_environment(first)}
        one = stack.enter_context(console(environment))
        asked = ("--domain", str(first), str(second))
        both = stack.enter_context(console(environment, *asked))
        yield Teams((first, second), (clients[0], clients[1]), crashed, one, both)


class Asker:
    """A page without a browser: sends what it likes and waits for the answer."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._id = 0

    def text(self, text: str) -> dict[str, Any]:
        self._connection.send(text)
        return self._told("answer")

    def __call__(self, **fields: Any) -> dict[str, Any]:
        self._id += 1
        return self.text(json.dumps({"id": self._id, "source": 0, **fields}))

    def status(self) -> dict[str, Any]:
        """Once the coach is known."""
        while not (status := self._told("status"))["ready"]:
            pass
        return status

    def _told(self, topic: str) -> dict[str, Any]:
        while True:
            message: dict[str, Any] = json.loads(self._connection.recv(timeout=WAIT_S))
            if message["type"] == topic:
                return message


@contextmanager
def asking(address: str) -> Iterator[Asker]:
    url = address.replace("http:", "ws:") + "live"
    with connect(url, open_timeout=WAIT_S, ping_interval=None) as connection:
        yield Asker(connection)


@contextmanager
def deaf_page(address: str) -> Iterator[None]:
    """A page that never reads what it is told."""
    host, _, port = address.removeprefix("http://").rstrip("/").partition(":")
    with socket.create_connection((host, int(port)), timeout=WAIT_S) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.sendall(
            f"GET /live HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            "Sec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        yield


def messages() -> st.SearchStrategy[str]:
    """Any text, any JSON, and what is almost a request, or is one."""
    names = st.sampled_from(["robot_1", "robot_2", "robot_3", "", "/coach"]) | st.text(max_size=5)
    numbers = st.integers(-2, 40) | st.floats() | st.integers()
    anything = st.recursive(
        st.none() | st.booleans() | numbers | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
        ),
        max_leaves=5,
    )
    modes = st.sampled_from([*mode_names(), "stay", "explode"])
    of_mode = ["steps", "p_good_to_bad", "vx", "linear_x", "sigma", "factor", "probability"]
    fields = {
        "id": st.integers(0, 9) | anything,
        "source": st.sampled_from([0, 0, 0, 1]) | anything,
        "victims": st.lists(names, max_size=3) | anything,
        "robots": st.lists(names, max_size=3) | anything,
        "mode": modes | anything,
        "parameters": st.dictionaries(st.sampled_from(of_mode), numbers, max_size=2) | anything,
        "apply_at": st.sampled_from(["next_step", "next_episode", "now"]),
        "start_step": numbers,
        "duration_steps": numbers,
        "on": st.booleans() | anything,
        "by": st.sampled_from([1, -1, 2]),
        "frame": numbers,
        "speed": numbers,
        "episode": numbers,
    }
    kinds = [
        "inject", "inject", "inject", "clear", "pause", "step", "reset", "forget", "seek", "pace",
        "choose", "hello",
    ]  # fmt: skip
    needed = {"inject": ["victims", "mode"], "pause": ["on"], "clear": ["robots"]}

    def like(kind: str) -> st.SearchStrategy[dict[str, Any]]:
        some = {name: fields[name] for name in ["id", "source", *needed.get(kind, [])]}
        more = {"inject": ["duration_steps", "apply_at"], "hello": list(fields)}.get(kind, [])
        optional = {name: fields[name] for name in more if name not in some}
        return st.fixed_dictionaries({"type": st.just(kind), **some}, optional=optional)

    requests = st.sampled_from(kinds).flatmap(like)
    return st.text(max_size=40) | anything.map(json.dumps) | requests.map(json.dumps)


@pytest.fixture(scope="session")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a console on a recording and on a scripted team, in this process."""
    team = Team()
    folder = tmp_path_factory.mktemp("recording") / "bag"
    bag = write(folder, team, messages_of([team.play(), team.play()]))
    sources = [
        EpisodeSource(0, Recording(bag)),
        EpisodeSource(1, Player(load_target("scripted:random", SCENARIO))),
    ]
    bound: SimpleQueue[int] = SimpleQueue()
    server = Server(make_app(sources, Access()), "127.0.0.1", 0, bound.put)
    thread = threading.Thread(target=server.run)
    for source in sources:
        source.start()
    thread.start()
    yield f"http://127.0.0.1:{bound.get(timeout=WAIT_S)}/"
    server.should_exit = True
    thread.join()
    for source in sources:
        source.close()


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
