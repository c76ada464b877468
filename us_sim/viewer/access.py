"""Access control of the page: it refuses requests of other origins, other hosts and strangers.

A page of another origin can send requests to this computer in a person's name, also by websocket,
so the request's origin must be the page's own. The host must be this computer's own name, as a
stranger's name may point to this computer (DNS rebinding). Other computers need a token: it is in
the address that a person opens, and then in a cookie (OWASP, Cross-Site WebSocket Hijacking; RFC
6454).

No other page may frame this one. Scripts run only from the server's files, or where the page itself
bears a nonce (W3C, Content Security Policy Level 3), so a text that became an element of the page
could not run anything.
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
"""Name of the cookie; with the port, as servers on two ports of one computer share cookies."""
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
    "script-src 'self' 'nonce-{nonce}' 'unsafe-eval'",
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
    """Return whether only this computer itself can reach the address or name."""
    if host.lower().rstrip(".") == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class AccessControl:
    """An ASGI application that passes permitted requests on to another.

    Args:
        app: the other application.
        token: of which each request must have a copy; "" permits only this computer's names.
    """

    def __init__(self, app: Any, token: str = "") -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if scope["type"] == "http":
            send = _add_safety_headers(scope, send)
        refusal = self._find_refusal(scope)
        if refusal:
            await _refuse(scope, receive, send, refusal)
        elif self._token and scope["type"] == "http" and self._has_token(scope):
            await self._set_cookie(scope, send)
        else:
            await self._app(scope, receive, send)

    def _find_refusal(self, scope: Any) -> str:
        """Return the reason to refuse a request, for a person; "" to permit it."""
        headers = dict(scope["headers"])
        host = headers.get(b"host", b"").decode("latin-1")
        name = _remove_port(host)
        if not self._token and not is_loopback(name):
            return f"{name or 'no host'} is not this computer: open the address as it was printed"
        origin = headers.get(b"origin", b"").decode("latin-1")
        if origin and origin.lower().partition("://")[2] != host.lower():
            return f"pages of {origin} may not use the viewer: open the address as it was printed"
        if self._token and not (self._has_token(scope) or self._has_cookie(scope, headers)):
            return "the token is missing: open the address as it was printed, with all of it"
        return ""

    def _has_token(self, scope: Any) -> bool:
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self._token.encode())

    def _has_cookie(self, scope: Any, headers: dict[bytes, bytes]) -> bool:
        try:
            cookies = SimpleCookie(headers.get(b"cookie", b"").decode("latin-1"))
        except CookieError:
            return False
        name = _name_cookie(scope)
        value = cookies[name].value if name in cookies else ""
        return hmac.compare_digest(value.encode(), self._token.encode())

    async def _set_cookie(self, scope: Any, send: Any) -> None:
        """Put the token into a cookie, and redirect to the address without it."""
        query = parse_qs(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        query.pop("token")
        rest = urlencode(query, doseq=True)
        where = f"/?{rest}" if rest else "/"
        cookie = f"{_name_cookie(scope)}={self._token}; Path=/; HttpOnly; SameSite=Strict"
        headers = [(b"location", where.encode()), (b"set-cookie", cookie.encode())]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


def _remove_port(host: str) -> str:
    """Return the name in a host header, without its port; "" for nonsense."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _add_safety_headers(scope: Any, send: Any) -> Any:
    """Return a sender that adds headers against misuse, and the nonce to a page's scripts."""
    nonce = secrets.token_urlsafe(16)
    host = dict(scope["headers"]).get(b"host", b"").decode("latin-1")
    # Older browsers do not take websockets for part of 'self'.
    sockets = f" ws://{host} wss://{host}" if re.fullmatch(r"[\w.:\[\]-]+", host) else ""
    policy = "; ".join(_POLICY).format(nonce=nonce, sockets=sockets)
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
            body = b"".join(page).replace(_SCRIPT, _SCRIPT + f' nonce="{nonce}"'.encode())
            kept = [each for each in begun["headers"] if each[0] != b"content-length"]
            await send({**begun, "headers": [*kept, (b"content-length", b"%d" % len(body))]})
            message = {**message, "body": body}
        await send(message)

    return answer


def _name_cookie(scope: Any) -> str:
    return COOKIE.format(port=(scope.get("server") or ("", 0))[1])


async def _refuse(scope: Any, receive: Any, send: Any, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": _CLOSED, "reason": why[:120]})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": _FORBIDDEN, "headers": headers})
    await send({"type": "http.response.body", "body": f"us_sim: {why}\n".encode()})
