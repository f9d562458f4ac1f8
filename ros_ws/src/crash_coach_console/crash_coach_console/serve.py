"""Serves sources as a page until a signal comes; then closes them in order."""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from types import FrameType
from urllib.parse import urlencode

from crash_coach_common.contract import UserError
from crash_coach_console.access import Access
from crash_coach_console.server import Server, make_app
from crash_coach_console.source import Source

PORT = 8642


def page_url(access: Access, port: int) -> str:
    """What a browser opens."""
    host = f"[{access.host}]" if ":" in access.host else access.host
    query = f"?{urlencode({'token': access.token})}" if access.token else ""
    return f"http://{host}:{port}/{query}"


def serve(
    sources: Sequence[Source], access: Access, port: int, on_ready: Callable[[str], None]
) -> None:
    """Returns after SIGINT, SIGTERM or SIGHUP. Call it from the main thread.

    Args:
        port: 0: any free one.
        on_ready: hears the page's address once it can be opened.

    Raises:
        UserError: the address cannot be used, or what a source raises as it starts or closes.
    """
    check_address(access.host, port)
    with ExitStack() as stack:
        for source in sources:
            source.start()
            stack.callback(source.close)
        server = Server(
            make_app(sources, access),
            access.host,
            port,
            lambda bound: on_ready(page_url(access, bound)),
        )
        with stopping(server):
            server.run()


def check_address(host: str, port: int) -> None:
    """Raises UserError where nobody could listen there."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((host, port))
    except OSError as error:
        raise UserError(f"{host} port {port}: {error.strerror}; choose another --port") from None


@contextmanager
def stopping(server: Server) -> Iterator[None]:
    """Signals end the server in order; uvicorn takes SIGINT and SIGTERM itself, and then raises
    them once more, which must not end this process before its sources are closed."""

    def note(number: int, frame: FrameType | None) -> None:
        server.should_exit = True

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
