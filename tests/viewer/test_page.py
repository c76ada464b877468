"""The page in a real browser: the image is drawn as it was sent, to scale, and only on demand."""

import socket
import urllib.error
import urllib.request
from typing import Any

import numpy as np
import pytest
from awaiting import until

from us_sim.errors import UsSimError
from us_sim.viewer.server import open_socket
from us_sim.viewer.stream import Feed, Packet, PageSources

PIXEL = 1e-4  # m
MATRIX = [PIXEL, 0, 0, -0.0256, 0, 0, 0, 0, 0, PIXEL, 0, PIXEL / 2, 0, 0, 0, 1]
READ = """() => {
    const canvas = document.querySelector(".us-image");
    const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    return [canvas.width, canvas.height, Array.from(data.filter((_, i) => i % 4 === 0))];
}"""


def offer(feed: Feed, pixels: Any) -> None:
    rows, columns = pixels.shape
    header = {"stamp": "1", "rows": rows, "columns": columns, "encoding": "mono8"}
    header["matrix"] = MATRIX
    feed.offer_packet(lambda sequence: Packet("image", sequence, header, pixels.tobytes()))


def feeds_of(sources: PageSources) -> tuple[Feed, list[bool]]:
    told: list[bool] = []
    image = Feed("image", told.append)
    sources.add_feeds(image)
    return image, told


@pytest.mark.smoke
def test_pixels_are_drawn_as_they_were_sent(page: Any, sources: PageSources) -> None:
    image, _ = feeds_of(sources)
    pixels = np.random.default_rng(1).integers(0, 256, (300, 512), dtype=np.uint8)
    offer(image, pixels)
    page.goto(page.address)
    page.wait_for_function("document.querySelector('.us-image')?.width === 512")
    columns, rows, shown = page.evaluate(READ)
    np.testing.assert_array_equal(np.reshape(shown, (rows, columns)), pixels)
    box = page.evaluate("document.querySelector('.us-image').getBoundingClientRect().toJSON()")
    assert box["width"] / box["height"] == pytest.approx(512 / 300, rel=1e-3)


@pytest.mark.parametrize(
    ("force", "words"), [({}, "no images come"), ({"force_age": 0.7}, "the tissue does not answer")]
)
def test_an_image_is_not_said_to_be_still_where_nothing_comes(
    page: Any, sources: PageSources, force: dict[str, float], words: str
) -> None:
    image, _ = feeds_of(sources)
    hand, probe = Feed("hand", rate=None), Feed("probe", rate=None)
    sources.add_feeds(hand, probe)
    place = {"stamp": "1", "position": [0, 0, 0], "quaternion": [0, 0, 0, 1], **force}
    probe.offer_packet(lambda sequence: Packet("probe", sequence, place, b""))
    hand.offer_packet(lambda sequence: Packet("hand", sequence, {"is_resting": True}, b""))
    page.goto(page.address)

    def is_at_rest() -> bool:
        offer(image, np.zeros((3, 4), np.uint8))
        return bool(page.locator("#readout").inner_text() == "still image")

    until(is_at_rest, "images come")
    page.wait_for_function(f"document.querySelector('#readout').textContent === '{words}'")


def test_a_page_finds_the_viewer_again(page: Any, sources: PageSources) -> None:
    image, _ = feeds_of(sources)
    page.goto(page.address)
    until(lambda: image.is_watched, "the page watches the image")
    page.evaluate("import('/us_sim/assets/stream.js').then(m => m.stream.reconnect())")
    until(lambda: not image.is_watched, "the page has left", 5.0)
    until(lambda: image.is_watched, "the page is back", 5.0)


def test_a_page_of_another_origin_gets_no_stream(browser: Any, served: Any) -> None:
    server, _ = served
    page = browser.new_page()
    page.goto("data:text/html,<p>evil</p>")
    for path in ("us_sim/stream", "_nicegui_ws/socket.io/?EIO=4&transport=websocket"):
        address = f"ws://127.0.0.1:{server.port}/{path}"
        outcome = page.evaluate(
            "address => new Promise(resolve => { const s = new WebSocket(address);"
            " s.onopen = () => resolve('open'); s.onerror = () => resolve('refused'); })",
            address,
        )
        assert outcome == "refused", path
    page.close()


def test_no_other_page_can_frame_it_and_no_markup_runs_script(browser: Any, served: Any) -> None:
    page = browser.new_page()
    page.set_content(f'<iframe src="{served[0].addresses[0]}"></iframe>')
    frame = until(lambda: page.frames[1:] and page.frames[1], "there is a frame")
    until(lambda: frame.url.startswith("chrome-error:"), "the browser refuses to fill it")
    page.goto(served[0].addresses[0])
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.evaluate("document.body.insertAdjacentHTML('beforeend', '<b onclick=\"XSS = 1\">b</b>')")
    page.locator("b", has_text="b").last.dispatch_event("click")
    until(lambda: any("Content Security Policy" in text for text in said), "it is refused")
    assert page.evaluate("window.XSS") is None
    page.close()


@pytest.mark.parametrize("path", ["/%1b[31m%0d%0a", "/us_sim/assets/%00"])
def test_a_path_that_is_not_there_leaves_nothing_in_the_log(
    served: Any, caplog: Any, path: str
) -> None:
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(served[0].addresses[0] + path[1:])
    assert refused.value.code == 404
    assert not caplog.records


def test_a_taken_port_is_said(served: Any) -> None:
    server, _ = served
    with pytest.raises(UsSimError, match=f"port {server.port} of 127.0.0.1 is taken"):
        open_socket("127.0.0.1", server.port)
    with pytest.raises(UsSimError, match=r"--host no\.such\.host\.invalid"):
        open_socket("no.such.host.invalid", 0)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))  # bound, and not listened at
        with pytest.raises(UsSimError, match="is taken"):
            open_socket("127.0.0.1", free.getsockname()[1])


def test_an_image_that_is_not_followed_by_another_is_marked(
    page: Any, sources: PageSources
) -> None:
    image, _ = feeds_of(sources)
    pixels = np.zeros((8, 8), np.uint8)
    offer(image, pixels)
    page.goto(page.address)
    page.get_by_text("No new image for 1 s").wait_for()
    offer(image, pixels)
    page.get_by_text("No new image").wait_for(state="hidden")
