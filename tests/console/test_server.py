"""The server without ROS: who may open it, what it answers, pages that do not read."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

import crash_coach_console
from crash_coach_console.access import Access
from crash_coach_console.episode_source import EpisodeSource
from crash_coach_console.player import Player
from crash_coach_console.serve import page_url
from crash_coach_console.server import Server, make_app
from policy_pkg.play.target import load_target

WAIT_S = 60.0
WEB = Path(crash_coach_console.__file__).parent / "web"
TOKEN = "an-open-sesame-for-tests"


@dataclass
class Served:
    source: EpisodeSource
    access: Access
    port: int
    asked: int = field(default=0)

    @property
    def host(self) -> str:
        return f"127.0.0.1:{self.port}"

    def get(self, path: str = "/", **headers: str) -> tuple[int, str, Any]:
        """(status, text, headers)"""
        request = Request(f"http://{self.host}{path}", headers=headers)
        try:
            with urlopen(request, timeout=WAIT_S) as answer:
                return answer.status, answer.read().decode(), answer.headers
        except HTTPError as error:
            return error.code, error.read().decode(), error.headers

    def open(self, **headers: str) -> ClientConnection:
        return connect(f"ws://{self.host}/live", additional_headers=headers, open_timeout=WAIT_S)


def ask(page: ClientConnection, text: str) -> dict[str, Any]:
    """Sends a message; skips what else is told, and returns the answer."""
    page.send(text)
    return told(page, "answer")


def told(page: ClientConnection, topic: str) -> dict[str, Any]:
    while True:
        message: dict[str, Any] = json.loads(page.recv(timeout=WAIT_S))
        if message["type"] == topic:
            return message


@contextmanager
def serving(access: Access) -> Iterator[Served]:
    source = EpisodeSource(0, Player(load_target("scripted:random", "buttons")))
    source.start()
    bound: list[int] = []
    ready = threading.Event()

    def on_bound(port: int) -> None:
        bound.append(port)
        ready.set()

    server = Server(make_app([source], access), "127.0.0.1", 0, on_bound)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        assert ready.wait(WAIT_S)
        yield Served(source, access, bound[0])
    finally:
        server.should_exit = True
        thread.join(WAIT_S)
        source.close()
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serving(Access()) as out:
        yield out


def test_the_page_comes_whole_and_may_load_nothing_from_elsewhere(served: Served) -> None:
    status, text, headers = served.get()
    assert (status, "<title>Crash Coach</title>" in text) == (200, True)
    assert "default-src 'self'" in headers["content-security-policy"]
    for path in WEB.iterdir():
        status, text, _ = served.get(f"/{path.name}")
        assert (status, text) == (200, path.read_text())
        assert "http:" not in text.replace("http://www.w3.org/2000/svg", "")
        assert "https:" not in text.replace('"https:"', "")
    assert served.get("/../server.py")[0] == 404


def test_other_hosts_and_other_pages_are_refused(served: Served) -> None:
    status, text, _ = served.get(Host=f"evil.example:{served.port}")
    assert status == 403
    assert "host 'evil.example" in text
    assert served.get(Origin="http://evil.example")[0] == 403
    assert served.get(Origin=f"http://{served.host}")[0] == 200
    with pytest.raises(InvalidStatus, match="403"):
        served.open(Origin="http://evil.example")
    with served.open(Origin=f"http://{served.host}") as page:
        assert told(page, "hello")["sources"][0]["kind"] == "episodes"


def test_with_a_token_nothing_is_told_without_it() -> None:
    with serving(Access("127.0.0.1", TOKEN)) as served:
        assert page_url(served.access, served.port).endswith(f"/?token={TOKEN}")
        assert served.get()[0] == 403
        assert served.get("/?token=wrong")[0] == 403
        status, _, headers = served.get(f"/?token={TOKEN}")
        assert status == 200
        cookie = headers["set-cookie"].partition(";")[0]
        assert "HttpOnly" in headers["set-cookie"]
        assert "SameSite=Strict" in headers["set-cookie"]
        assert served.get("/main.js", Cookie=cookie)[0] == 200
        with pytest.raises(InvalidStatus, match="403"):
            served.open()
        with served.open(Cookie=cookie) as page:
            told(page, "hello")


def test_a_page_is_told_modes_arena_and_states(served: Served) -> None:
    with served.open() as page:
        hello = told(page, "hello")
        (delay,) = (mode for mode in hello["modes"] if mode["name"] == "delay")
        assert [parameter["name"] for parameter in delay["parameters"]] == ["steps"]
        arena = told(page, "arena")
        assert arena["scenario"] == "buttons"
        assert [actor["name"] for actor in arena["actors"]] == ["robot_1", "robot_2"]
        ask(page, '{"type": "seek", "id": 1, "source": 0, "frame": 0}')
        ask(page, '{"type": "pause", "id": 2, "source": 0, "on": false}')
        steps = [told(page, "state")["step"] for _ in range(3)]
        assert steps == sorted(steps)


def test_what_is_wrong_is_answered_and_the_page_goes_on(served: Served) -> None:
    with served.open() as page:
        for text, reason in (
            ("no json", "Invalid JSON"),
            ('{"type": "clear", "id": 5, "source": 9}', "source 9: there are 1"),
            (
                '{"type": "inject", "id": 6, "source": 0, "victims": ["robot_9"], "mode": "mute"}',
                "unknown robot 'robot_9'; one of: robot_1, robot_2",
            ),
            (
                '{"type": "inject", "id": 6, "source": 0, "victims": ["robot_1"], "mode": "no"}',
                "unknown crash mode 'no'; one of: mute",
            ),
            (
                '{"type": "inject", "id": 6, "source": 0, "victims": ["robot_1", "robot_1"], '
                '"mode": "mute"}',
                "robot_1 more than once",
            ),
        ):
            answer = ask(page, text)
            assert (answer["ok"], reason in answer["text"]) == (False, True), answer
        page.send(b"\x00\xff")
        assert told(page, "answer")["ok"] is False
        good = '{"type": "step", "id": 7, "source": 0}'
        assert ask(page, good) == {"type": "answer", "id": 7, "ok": True, "text": ""}


def test_a_page_that_does_not_read_holds_up_nobody(served: Served) -> None:
    """It is owed megabytes; another page, opened later, is told what is newest all the same."""
    deaf = socket.create_connection(("127.0.0.1", served.port), timeout=WAIT_S)
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    key = "dGhlIHNhbXBsZSBub25jZQ=="
    deaf.sendall(
        f"GET /live HTTP/1.1\r\nHost: {served.host}\r\nUpgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
        "\r\n".encode()
    )
    with deaf, served.open() as page:
        told(page, "hello")
        posted = 0
        until_s = time.monotonic() + 2.0
        while time.monotonic() < until_s:
            served.source.board.post("ballast", {"k": posted, "text": "x" * 100_000})
            posted += 1
            time.sleep(0.01)
        assert posted > 100
        while told(page, "ballast")["k"] != posted - 1:
            pass
        answer = ask(page, '{"type": "step", "id": 8, "source": 0}')
        assert answer["ok"]
        served.source.board.post("ballast", {"k": -1})
