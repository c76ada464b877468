"""Who may open the page: closed by default, so that no other page and no stranger can.

A page of another origin can send requests to this computer in a person's name. So a request that
says it comes from another origin is refused, websockets among them, for which browsers have no such
rule of their own. A name that a stranger's server lets point to this computer (DNS rebinding) is
refused by the request's host. Beyond this computer a token is needed: it is in the address that a
person opens, and then in a cookie (OWASP, Cross-Site WebSocket Hijacking; RFC 6454).
"""

from __future__ import annotations

import hmac
import ipaddress
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

__all__ = ["Access", "is_loopback"]

COOKIE = "us_sim_viewer_{port}"
"""Cookies of two servers of one computer would be one, since they do not tell ports apart."""
_FORBIDDEN, _CLOSED = 403, 1008


def is_loopback(host: str) -> bool:
    """Whether an address, or a name, is this computer's own alone."""
    if host.lower().rstrip(".") == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class Access:
    """An ASGI application that lets through to another only what may pass.

    Args:
        app: the other.
        token: that a request must bear; "" is none, and only this computer's names will do.
    """

    def __init__(self, app: Any, token: str = "") -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        wrong = self._wrong(scope)
        if wrong:
            await _refuse(scope, receive, send, wrong)
        elif self._token and scope["type"] == "http" and self._given(scope):
            await self._welcome(scope, send)
        else:
            await self._app(scope, receive, send)

    def _wrong(self, scope: Any) -> str:
        """Why a request is refused, for a person; "" where it is not."""
        headers = dict(scope["headers"])
        host = headers.get(b"host", b"").decode("latin-1")
        name = _name(host)
        if not self._token and not is_loopback(name):
            return f"{name or 'no host'} is not this computer: open the address as it was printed"
        origin = headers.get(b"origin", b"").decode("latin-1")
        if origin and origin.lower().partition("://")[2] != host.lower():
            return f"pages of {origin} may not use the viewer: open the address as it was printed"
        if self._token and not (self._given(scope) or self._has_cookie(scope, headers)):
            return "the token is missing: open the address as it was printed, with all of it"
        return ""

    def _given(self, scope: Any) -> bool:
        """Whether the token is in the address."""
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self._token.encode())

    def _has_cookie(self, scope: Any, headers: dict[bytes, bytes]) -> bool:
        try:
            cookies = SimpleCookie(headers.get(b"cookie", b"").decode("latin-1"))
        except CookieError:
            return False
        name = _cookie(scope)
        value = cookies[name].value if name in cookies else ""
        return hmac.compare_digest(value.encode(), self._token.encode())

    async def _welcome(self, scope: Any, send: Any) -> None:
        """Put the token into a cookie, and show the address without it."""
        query = parse_qs(scope["query_string"].decode("latin-1"))
        query.pop("token")
        rest = urlencode(query, doseq=True)
        where = scope["path"] + (f"?{rest}" if rest else "")
        cookie = f"{_cookie(scope)}={self._token}; Path=/; HttpOnly; SameSite=Strict"
        headers = [(b"location", where.encode()), (b"set-cookie", cookie.encode())]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


def _name(host: str) -> str:
    """The host's name without its port; "" where it is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _cookie(scope: Any) -> str:
    return COOKIE.format(port=(scope.get("server") or ("", 0))[1])


async def _refuse(scope: Any, receive: Any, send: Any, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": _CLOSED, "reason": why[:120]})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": _FORBIDDEN, "headers": headers})
    await send({"type": "http.response.body", "body": f"us_sim: {why}\n".encode()})
