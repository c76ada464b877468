"""Who may open the page: closed by default, so that no other page and no stranger can.

A page of another origin can send requests to this computer in a person's name. So a request that
says it comes from another origin is refused, websockets among them, for which browsers have no such
rule of their own. A name that a stranger's server lets point to this computer (DNS rebinding) is
refused by the request's host. Beyond this computer a token is needed: it is in the address that a
person opens, and then in a cookie (OWASP, Cross-Site WebSocket Hijacking; RFC 6454).

No other page may frame this one, and scripts run only from files of the server, or where the page
itself bears a number that is used once (W3C, Content Security Policy Level 3): a text that became
an element of the page could not run anything.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

COOKIE = "us_sim_viewer_{port}"
"""Cookies of two servers of one computer would be one, since they do not tell ports apart."""
_FORBIDDEN, _CLOSED = 403, 1008
_SAFETY = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),
)
_POLICY = (
    "default-src 'none'",
    # Vue compiles the templates of NiceGUI's elements and ours in the browser, and NiceGUI's
    # server calls methods of elements by `eval`.
    "script-src 'self' 'nonce-{number}' 'unsafe-eval'",
    # Vue and Quasar write style attributes, and the page's template has style elements.
    "style-src 'self' 'unsafe-inline'",
    "img-src 'self' data: blob:",  # pictures that the page itself has made
    "media-src 'self' blob:",
    "font-src 'self'",
    "connect-src 'self'{sockets}",
    "worker-src 'self' blob:",
    "base-uri 'none'",
    "form-action 'none'",
    "frame-ancestors 'none'",
)
_SCRIPT = b"<script"  # as NiceGUI's page has it; texts from elsewhere are in it with ``<`` escaped


def is_loopback(host: str) -> bool:
    """Whether an address, or a name, is this computer's own alone."""
    if host.lower().rstrip(".") == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class AccessControl:
    """An ASGI application that passes only permitted requests on to another.

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
        if scope["type"] == "http":
            send = _safely(scope, send)
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
        """Put the token into a cookie, and show the one page there is, without it."""
        query = parse_qs(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        query.pop("token")
        rest = urlencode(query, doseq=True)
        where = f"/?{rest}" if rest else "/"
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


def _safely(scope: Any, send: Any) -> Any:
    """A sender that adds headers against misuse, and to a page's scripts the number to run."""
    number = secrets.token_urlsafe(16)
    host = dict(scope["headers"]).get(b"host", b"").decode("latin-1")
    # Older browsers do not take websockets for part of 'self'.
    sockets = f" ws://{host} wss://{host}" if re.fullmatch(r"[\w.:\[\]-]+", host) else ""
    policy = "; ".join(_POLICY).format(number=number, sockets=sockets)
    begun: dict[str, Any] = {}
    page: list[bytes] = []

    async def answer(message: Any) -> None:
        if message["type"] == "http.response.start":
            headers = [*message["headers"], *_SAFETY]
            headers.append((b"content-security-policy", policy.encode("latin-1")))
            message = {**message, "headers": headers}
            if dict(headers).get(b"content-type", b"").startswith(b"text/html"):
                begun.update(message)
                return
        elif begun and message["type"] == "http.response.body":
            page.append(message.get("body", b""))
            if message.get("more_body"):
                return
            body = b"".join(page).replace(_SCRIPT, _SCRIPT + f' nonce="{number}"'.encode())
            kept = [each for each in begun["headers"] if each[0] != b"content-length"]
            await send({**begun, "headers": [*kept, (b"content-length", b"%d" % len(body))]})
            message = {**message, "body": body}
        await send(message)

    return answer


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
