"""One page's connection: what is new goes out at a viewer's pace, requests come in one by one."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from crash_coach_common.contract import UserError
from crash_coach_console.board import Cursor
from crash_coach_console.modes import modes_value
from crash_coach_console.requests import RequestError, parse_request
from crash_coach_console.source import Source

PACE_S = 1 / 30
"""A page is told of what is new this often, at most."""

Send = Callable[[str], Awaitable[None]]


def hello(sources: Sequence[Source]) -> str:
    """The first message to a page: which sources there are, which faults."""
    shown = [{"title": source.title, "kind": source.kind} for source in sources]
    return json.dumps({"type": "hello", "sources": shown, "modes": modes_value()})


async def tell(sources: Sequence[Source], send: Send) -> None:
    """Sends what is new, for ever. A page that does not read holds up this and nothing else."""
    await send(hello(sources))
    cursors = [Cursor() for _ in sources]
    while True:
        for source, cursor in zip(sources, cursors, strict=True):
            for message in source.board.since(cursor):
                await send(message)
        await asyncio.sleep(PACE_S)


async def answer(sources: Sequence[Source], text: str) -> str:
    """The answer to one message of a page, whatever it is."""
    try:
        request = parse_request(text)
        if request.source >= len(sources):
            raise RequestError(f"source {request.source}: there are {len(sources)}", request.id)
        said = await sources[request.source].act(request)
    except RequestError as error:
        return _answer(error.request_id, False, str(error))
    except UserError as error:
        return _answer(request.id, False, str(error))
    return _answer(request.id, True, said)


def _answer(request_id: int, ok: bool, text: str) -> str:
    value: dict[str, Any] = {"type": "answer", "id": request_id, "ok": ok, "text": text}
    return json.dumps(value)
