"""Who may open the page."""

import asyncio
import threading
from typing import Any

import pytest

from us_sim.errors import UsSimError
from us_sim.viewer.access import AccessControl, is_loopback
from us_sim.viewer.server import WebServer
from us_sim.viewer.stream import PageSources


def asked(
    token: str = "",
    *,
    kind: str = "http",
    host: str = "127.0.0.1:8080",
    origin: str = "",
    query: str = "",
    cookie: str = "",
    path: str = "/",
    app: Any = None,
) -> Any:
    """The answer: "passed", or the messages of the refusal."""
    headers = [(b"host", host.encode())]
    if origin:
        headers.append((b"origin", origin.encode()))
    if cookie:
        headers.append((b"cookie", cookie.encode()))
    scope = {
        "type": kind,
        "path": path,
        "headers": headers,
        "query_string": query.encode(),
        "server": ("127.0.0.1", 8080),
    }
    sent: list[Any] = []

    async def passed(_: Any, __: Any, send: Any) -> None:
        await send({"type": "passed"})

    async def receive() -> Any:
        return {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        sent.append(message)

    # In a thread of its own: in this one a browser of other tests may have its loop.
    answering = threading.Thread(
        target=lambda: asyncio.run(AccessControl(app or passed, token)(scope, receive, send))
    )
    answering.start()
    answering.join()
    return "passed" if sent == [{"type": "passed"}] else sent


@pytest.mark.parametrize("host", ["localhost:9000", "[::1]:8080", "127.1.2.3"])
@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_this_computer_may(host: str, kind: str) -> None:
    assert asked(host=host, kind=kind) == "passed"
    assert asked(host=host, kind=kind, origin=f"http://{host}") == "passed"


@pytest.mark.parametrize(
    ("asking", "word"),
    [
        *(
            ({"origin": origin}, b"may not use the viewer")
            for origin in (
                "http://evil.example",
                "http://127.0.0.1:8081",
                "null",
            )
        ),
        *(({"host": host}, b"as it was printed") for host in ("evil.example:8080", "", "[::1")),
    ],
)
def test_other_origins_and_other_names_may_not(asking: dict[str, str], word: bytes) -> None:
    closed = asked(kind="websocket", **asking)
    assert [m["type"] for m in closed] == ["websocket.close"]
    refused = asked(**asking)
    assert refused[0]["status"] == 403
    assert word in refused[1]["body"]


def test_beyond_this_computer_a_token_is_needed() -> None:
    host = "lab.example:8080"
    assert asked("secret", host=host)[0]["status"] == 403
    assert asked("secret", host=host, query="token=other")[0]["status"] == 403
    welcome = asked("secret", host=host, query="token=secret&a=1&watch")
    headers = dict(welcome[0]["headers"])
    assert welcome[0]["status"] == 303
    assert headers[b"location"] == b"/?a=1&watch="
    cookie = headers[b"set-cookie"].decode()
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    pair = cookie.split(";")[0]
    assert asked("secret", host=host, cookie=pair) == "passed"
    assert asked("secret", host=host, cookie=pair, kind="websocket") == "passed"
    assert asked("secret", host=host, cookie="a=b")[0]["status"] == 403
    foreign = asked(
        "secret", host=host, cookie=pair, kind="websocket", origin="http://evil.example"
    )
    assert foreign[0]["type"] == "websocket.close"


@pytest.mark.parametrize("path", ["//evil.example/", "/\r\nset-cookie: a=b", "/us_sim/é\0"])
def test_the_token_leads_to_the_page_and_nowhere_else(path: str) -> None:
    welcome = asked("secret", host="lab.example", path=path, query="token=secret&b=%0d%0a&a=//c")
    headers = dict(welcome[0]["headers"])
    assert headers[b"location"] == b"/?b=%0D%0A&a=%2F%2Fc"


@pytest.mark.parametrize(
    ("token", "what"),
    [("", {}), ("secret", {"query": "token=secret"})],
)
def test_every_answer_keeps_the_page_out_of_others(token: str, what: dict[str, Any]) -> None:
    async def app(_: Any, __: Any, send: Any) -> None:
        headers = [(b"content-type", b"text/html"), (b"content-length", b"27")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        for body, more in ((b"<scr", True), (b"ipt>1</script><b>", False)):
            await send({"type": "http.response.body", "body": body, "more_body": more})

    start, body = asked(token, app=app, **what)
    headers = dict(start["headers"])
    assert headers[b"x-frame-options"] == b"DENY"
    assert headers[b"x-content-type-options"] == b"nosniff"
    policy = dict(
        each.split(" ", 1) for each in headers[b"content-security-policy"].decode().split("; ")
    )
    assert policy["frame-ancestors"] == policy["default-src"] == "'none'"
    assert "'unsafe-inline'" not in policy["script-src"]
    if start["status"] == 200:
        number = policy["script-src"].partition("'nonce-")[2].partition("'")[0]
        assert body["body"] == f'<script nonce="{number}">1</script><b>'.encode()
        assert headers[b"content-length"] == b"%d" % len(body["body"])
        assert number not in str(asked(token, app=app, **what))


def test_loopback_is_told_from_other_addresses() -> None:
    assert all(map(is_loopback, ("localhost", "127.0.0.1", "::1", "127.8.8.8", "[::1]")))
    assert not any(map(is_loopback, ("0.0.0.0", "", "192.168.0.2", "::", "localhost.evil")))


@pytest.mark.parametrize("token", ["a" * 15, "a" * 16 + "; Path=/"])
def test_a_token_that_is_no_secret_or_no_part_of_an_address_is_refused(token: str) -> None:
    pytest.importorskip("nicegui", reason="nicegui is not installed")
    with pytest.raises(UsSimError, match="16 letters, digits"):
        WebServer(PageSources(), "0.0.0.0", 0, token)
