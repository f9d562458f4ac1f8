"""What a page can show: a live graph, a recording, an episode, a training run."""

from __future__ import annotations

from typing import Literal, Protocol

from crash_coach_console.board import Board
from crash_coach_console.requests import Request

Kind = Literal["graph", "recording", "episodes", "run"]
"""run: a training's curves alone."""


class Source(Protocol):
    """Started once, closed once; between, ``act`` is called from one event loop."""

    @property
    def title(self) -> str: ...
    @property
    def kind(self) -> Kind: ...
    @property
    def board(self) -> Board:
        """What it shows; may be read before ``start`` and after ``close``."""
        ...

    def start(self) -> None: ...
    def close(self) -> None: ...

    async def act(self, request: Request) -> str:
        """Does what a page asks for; returns one line that says what was done.

        Raises:
            UserError: it was not done; the text is the reason.
        """
        ...
