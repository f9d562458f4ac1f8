"""Who may open the console: this machine's own browser at this address, or who has the token."""

from __future__ import annotations

import hmac
import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from crash_coach_common.contract import UserError

COOKIE = "crash_coach_token"
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
LEAST_TOKEN = 16


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Access:
    """Raises UserError for an address beyond this machine without a token, or a short token."""

    host: str = "127.0.0.1"
    token: str = ""

    def __post_init__(self) -> None:
        if not self.token and not is_loopback(self.host):
            raise UserError(
                f"--host {self.host}: others reach this address; give a --token that they need"
            )
        if self.token and len(self.token) < LEAST_TOKEN:
            raise UserError(
                f"--token of {len(self.token)} characters: at least {LEAST_TOKEN} are needed"
            )

    def refusal(self, headers: Mapping[str, str], query: str) -> str:
        """Why a request is refused; '' where it is not. ``headers``: with lower-case names.

        The name in Host keeps out pages whose name was made to lead here (DNS rebinding), Origin
        keeps out other pages, also from WebSockets, which browsers let them open.
        """
        host = headers.get("host", "")
        name = _name_of(host)
        if not self.token and name not in LOOPBACK_NAMES:
            return f"host {host!r} is not this machine"
        origin = headers.get("origin")
        if origin is not None and not self._own(origin, host):
            return f"origin {origin!r} is another page's"
        if self.token and not self._knows_token(headers, query):
            return "the token is missing or wrong: open the address that the console printed"
        return ""

    def _own(self, origin: str, host: str) -> bool:
        parts = urlsplit(origin)
        return parts.scheme in ("http", "https") and parts.netloc == host != ""

    def _knows_token(self, headers: Mapping[str, str], query: str) -> bool:
        given = parse_qs(query).get("token", [])
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            cookie = None
        given += [] if cookie is None else [cookie.value]
        return any(hmac.compare_digest(g.encode(), self.token.encode()) for g in given)


def _name_of(host: str) -> str:
    """Of a Host header, without the port."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]
