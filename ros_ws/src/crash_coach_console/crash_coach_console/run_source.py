"""A training that has no checkpoint yet, or none that can be played here: its curves alone."""

from __future__ import annotations

import threading
from pathlib import Path

from crash_coach_common.contract import UserError
from crash_coach_console.board import Board
from crash_coach_console.curves import LOOK_S, Curves
from crash_coach_console.requests import Request
from crash_coach_console.source import Kind


class RunSource:
    """Looks at ``folder`` once a second."""

    kind: Kind = "run"

    def __init__(self, number: int, folder: Path) -> None:
        self.board = Board(number)
        self.title = folder.name
        self._curves = Curves(folder)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="curves", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            for topic, value in self._curves.pages().items():
                self.board.post(topic, value)
            self._stop.wait(LOOK_S)

    async def act(self, request: Request) -> str:
        raise UserError(f"{request.type}: a training cannot do that; only its curves are shown")
