"""The HTTP and WebSocket server: the page's files, and a connection per page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from socket import socket

import uvicorn
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Mount, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from crash_coach_console import hub
from crash_coach_console.access import COOKIE, Access
from crash_coach_console.requests import MOST_BYTES
from crash_coach_console.source import Source

_REFUSED = 4403  # WebSocket close code: ours
_HEADERS = {
    "content-security-policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",
}


class Guard:
    """Lets through what Access allows, and says in every answer what a page may do."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        refusal = self._access.refusal(headers, scope["query_string"].decode("latin-1"))
        if refusal and scope["type"] == "http":
            response = PlainTextResponse(f"Crash Coach console: {refusal}\n", 403)
            await response(scope, receive, send)
        elif refusal:
            # Closed before it is accepted: the browser is told 403.
            await receive()
            await send({"type": "websocket.close", "code": _REFUSED, "reason": refusal[:100]})
        else:
            await self._app(scope, receive, self._marked(send))

    def _marked(self, send: Send) -> Send:
        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                more = dict(_HEADERS)
                if self._access.token:
                    more["set-cookie"] = (
                        f"{COOKIE}={self._access.token}; HttpOnly; SameSite=Strict; Path=/"
                    )
                pairs = [(name.encode(), value.encode()) for name, value in more.items()]
                message["headers"] = [*message.get("headers", []), *pairs]
            await send(message)

        return marked


def make_app(sources: Sequence[Source], access: Access) -> ASGIApp:
    """The application; the sources are started and closed by others."""

    async def page(socket: WebSocket) -> None:
        await socket.accept()
        telling = asyncio.create_task(hub.tell(sources, socket.send_text))
        try:
            while socket.application_state is WebSocketState.CONNECTED:
                message = await socket.receive()
                if message["type"] != "websocket.receive":
                    break
                text = message.get("text")
                asked = "" if text is None else text  # bytes are no request
                await socket.send_text(await hub.answer(sources, asked))
        except (WebSocketDisconnect, RuntimeError):
            pass  # it closed while it was answered
        finally:
            telling.cancel()

    static = StaticFiles(packages=[("crash_coach_console", "web")], html=True)
    app = Starlette(routes=[WebSocketRoute("/live", page), Mount("/", static)])
    return Guard(app, access)


class Server(uvicorn.Server):
    """``on_bound`` hears the port, once, when pages can come."""

    def __init__(self, app: ASGIApp, host: str, port: int, on_bound: Callable[[int], None]) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                host=host,
                port=port,
                log_level="warning",
                access_log=False,
                proxy_headers=False,
                server_header=False,
                ws="websockets-sansio",
                ws_max_size=MOST_BYTES,
                ws_max_queue=8,
                ws_per_message_deflate=False,
                timeout_graceful_shutdown=1,
            )
        )
        self._on_bound = on_bound

    async def startup(self, sockets: list[socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._on_bound(self.servers[0].sockets[0].getsockname()[1])
