"""Episodes that are over, from a recording or played without ROS, as a source with a time line."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Protocol

from crash_coach_common.contract import UserError
from crash_coach_console.board import Board
from crash_coach_console.episodes import Costs, Played
from crash_coach_console.film import Film
from crash_coach_console.playback import Playback
from crash_coach_console.requests import (
    Choose,
    Clear,
    Forget,
    Inject,
    Pace,
    Pause,
    Request,
    Reset,
    Seek,
    StepOnce,
)
from crash_coach_console.source import Kind

TICK_S = 1 / 60
SHOWN_EPISODES = 500


class Reel(Protocol):
    """Where episodes come from; used by one thread. Each raises UserError with the reason."""

    title: str
    kind: Kind

    def first(self) -> Film: ...
    def choose(self, episode: int) -> Film: ...
    def after(self, film: Film) -> Film:
        """The next episode."""
        ...

    def crash(self, film: Film, asked: Inject, frame: int) -> tuple[Film, str]:
        """The same episode with robots crashed, and what was done."""
        ...

    def clear(self, film: Film, robots: Sequence[str]) -> tuple[Film, str]: ...
    def more(self) -> list[Played]:
        """Outcomes of further episodes, found a few at a time; empty: nothing more is known now."""
        ...

    def pages(self) -> dict[str, dict[str, Any]]:
        """What else is shown, by topic, where it has changed."""
        ...


class EpisodeSource:
    """Plays what ``reel`` gives, in a thread of its own."""

    def __init__(self, number: int, reel: Reel) -> None:
        self.board = Board(number)
        self._reel = reel
        self._playback = Playback()
        self._costs = Costs()
        self._outcomes: dict[int, dict[str, Any]] = {}
        self._film: Film | None = None
        self._shown = -1
        self._timeline: dict[str, Any] = {}
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="playback", daemon=True)

    @property
    def title(self) -> str:
        return self._reel.title

    @property
    def kind(self) -> Kind:
        return self._reel.kind

    def start(self) -> None:
        """Raises UserError where there is no first episode."""
        self._take(self._reel.first())
        self._post_status()
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    # --- the thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        then_s = time.monotonic()
        while not self._stop.is_set():
            with contextlib.suppress(queue.Empty):
                self._tasks.get(timeout=TICK_S)()
            now_s = time.monotonic()
            self._playback.advance(now_s - then_s)
            then_s = now_s
            self._show()
            for played in self._reel.more():
                self._count(played)
            for topic, value in self._reel.pages().items():
                self.board.post(topic, value)

    def _take(self, film: Film) -> None:
        """Shows another film."""
        before = self._film
        self._film, self._shown = film, -1
        if before is None or before.arena() != film.arena():
            self.board.post("arena", film.arena())
        self._playback.load(film.frames.steps, film.frames.dt_s, film.begin)
        self._playback.playing = True
        self._show()

    def _count(self, played: Played) -> None:
        self._costs.add(played)
        self._outcomes[played.episode] = {
            "episode": played.episode,
            "success": played.success,
            "crashed": list(played.crashed),
        }
        # What a team plays for comparison was not drawn at any rate: all together mean nothing.
        self.board.post("costs", {"rows": self._costs.rows(together=self.kind == "recording")})
        self._post_timeline()

    def _show(self) -> None:
        frame, film = self._playback.frame, self._film
        if film is None:
            return
        if frame != self._shown:
            self._shown = frame
            self.board.post("state", film.state(frame))
            self.board.post("team", film.team(frame))
        self._post_timeline()

    def _post_timeline(self) -> None:
        film = self._film
        if film is None:
            return
        value = {
            **self._playback.value(),
            "frame": self._playback.frame,
            "episode": film.frames.episode,
            "stretches": film.stretches,
            "episodes": list(self._outcomes.values())[-SHOWN_EPISODES:],
        }
        if value != self._timeline:
            self._timeline = value
            self.board.post("timeline", value)

    def _post_status(self) -> None:
        self.board.post(
            "status",
            {
                "title": self.title,
                "alive": {},
                "ready": True,
                "paused": False,
                "ends_faults": False,
            },
        )

    # --- what pages ask for -----------------------------------------------------------------------

    async def act(self, request: Request) -> str:
        done: Future[str] = Future()

        def work() -> None:
            try:
                done.set_result(self._do(request))
            except UserError as error:
                done.set_exception(error)

        self._tasks.put(work)
        return await asyncio.wrap_future(done)

    def _do(self, request: Request) -> str:
        film, frame = self._film, self._playback.frame
        assert film is not None  # shown since the start
        match request:
            case Pause():
                self._playback.play(not request.on)
                return "paused" if request.on else "playing"
            case StepOnce():
                self._playback.step(request.by)
            case Seek():
                self._playback.seek(request.frame)
            case Pace():
                self._playback.speed = request.speed
            case Choose():
                self._take(self._reel.choose(request.episode))
            case Reset():
                self._take(self._reel.after(film))
            case Forget():
                self._costs.forget()
                self._outcomes.clear()
                self.board.post("costs", {"rows": []})
            case Inject():
                crashed, said = self._reel.crash(film, request, frame)
                self._take(crashed)
                return said
            case Clear():
                cleared, said = self._reel.clear(film, request.robots)
                self._take(cleared)
                return said
        return ""
