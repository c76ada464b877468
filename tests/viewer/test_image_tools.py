"""Measuring, freezing and keeping the image in a real browser, against a geometry that is known."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from awaiting import until

from us_sim.viewer.session import SessionState
from us_sim.viewer.stream import Feed, Packet, PageSources

COLUMNS, ROWS = 400, 300
ACROSS, DOWN = 1e-4, 1.4e-4  # m a pixel: not square
MATRIX = [ACROSS, 0, 0, -0.02, 0, 0, 0, 0, 0, DOWN, 0, DOWN / 2, 0, 0, 0, 1]
TOOLS = "/us_sim/assets/image_tools"


class Images:
    """Images whose grey value is their number, each a second after the one before."""

    def __init__(self, sources: PageSources) -> None:
        self.feed = Feed("image", rate=None)
        sources.add_feeds(self.feed)

    def show(self, grey: int, **known: Any) -> None:
        stamp = {"stamp": str(grey * 10**9), "encoding": "mono8"}
        header = {"rows": ROWS, "columns": COLUMNS, "matrix": MATRIX, **stamp, **known}
        self.feed.offer_packet(
            lambda n: Packet("image", n, header, bytes([grey]) * (ROWS * COLUMNS))
        )


pytestmark = pytest.mark.usefixtures("images")


@pytest.fixture
def images(page: Any, sources: PageSources) -> Images:
    images = Images(sources)
    images.show(40)
    page.goto(page.address)
    page.wait_for_selector(".us-image-bar")
    await_grey(page, 40)
    distance = page.get_by_role("button", name="Distance", exact=True)
    until(distance.is_enabled, "it is known where the pixels are")
    return images


def await_grey(page: Any, grey: int) -> None:
    page.wait_for_function(
        f"""() => {{
            const canvas = document.querySelector(".us-image");
            return canvas.width === {COLUMNS} &&
                canvas.getContext("2d").getImageData(9, 9, 1, 1).data[0] === {grey};
        }}"""
    )


def test_nothing_is_drawn_or_measured_before_the_first_image(
    browser: Any, served: Any, sources: PageSources, images: Images
) -> None:
    sources.feeds["image"] = Feed("image", rate=None)
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    page.goto(served[0].addresses[0])
    page.get_by_text("Waiting for the first image").wait_for()
    page.set_viewport_size({"width": 1100, "height": 720})  # which has the scale drawn
    page.wait_for_function("document.querySelector('.us-scale').width > 300")
    drawn = """() => {
        const scale = document.querySelector('.us-scale');
        const data = scale.getContext('2d').getImageData(0, 0, scale.width, scale.height).data;
        return data.some((value) => value > 0);
    }"""
    assert not page.evaluate(drawn)
    button = page.get_by_role("button", name="Distance", exact=True)
    of_an_image = [
        page.get_by_role("button", name=name, exact=True) for name in ("Freeze", "Play", "Save")
    ]
    assert button.is_disabled()
    assert all(each.is_disabled() for each in of_an_image)
    for key in (" ", "c", ",", "."):
        page.keyboard.press(key)
    assert not page.evaluate(f"import('{TOOLS}/freeze.js').then(m => m.freeze.isFrozen)")
    page.keyboard.press("p")
    assert page.evaluate(f"import('{TOOLS}/picture.js').then(m => m.picture())") is None
    sources.feeds["image"] = images.feed
    page.evaluate("import('/us_sim/assets/stream.js').then(m => m.stream.reconnect())")
    page.wait_for_function(drawn)
    until(button.is_enabled, "distances can be measured")
    until(lambda: all(each.is_enabled() for each in of_an_image), "there is an image")
    page.close()


def at(page: Any, lateral: float, depth: float) -> tuple[float, float]:
    """Where a place of the image plane, mm, is on the page."""
    box = page.evaluate("document.querySelector('.us-image').getBoundingClientRect().toJSON()")
    column, row = (lateral + 20) * 1e-3 / ACROSS, depth * 1e-3 / DOWN - 0.5
    x = box["x"] + (column + 0.5) / COLUMNS * box["width"]
    return x, box["y"] + (row + 0.5) / ROWS * box["height"]


def drag(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=6)
    page.mouse.up()


def values(page: Any) -> list[str]:
    return page.locator(".us-values li").evaluate_all(
        "items => items.map(item => item.firstChild.textContent)"
    )


@pytest.mark.parametrize(("start", "end"), [((0, 6), (0, 33)), ((-12, 10), (9, 31))])
def test_distances_are_right_to_a_tenth_of_a_millimetre(
    page: Any, start: tuple[float, float], end: tuple[float, float]
) -> None:
    page.keyboard.press("d")
    drag(page, at(page, *start), at(page, *end))
    (value,) = values(page)
    assert value.endswith(" mm")
    assert float(value.split()[0]) == pytest.approx(math.dist(start, end), abs=0.1)


def test_a_point_that_is_dragged_out_of_the_image_stays_at_its_border(page: Any) -> None:
    page.keyboard.press("d")
    drag(page, at(page, 0, 10), at(page, 0, 60))
    assert values(page) == ["32.0 mm"]  # 300 rows end at 42 mm


def test_several_distances_and_their_ends_can_be_dragged(page: Any) -> None:
    for depth, length in ((8, 10), (20, 6)):
        page.get_by_role("button", name="Distance", exact=True).click()
        drag(page, at(page, 0, depth), at(page, length, depth))
    drag(page, at(page, 6, 20), at(page, 8, 20))
    first, second = (float(value.split()[0]) for value in values(page))
    assert (first, second) == pytest.approx((10, 8), abs=0.1)
    page.set_viewport_size({"width": 1024, "height": 700})
    assert [float(value.split()[0]) for value in values(page)] == [first, second]
    page.locator(".us-handle").first.focus()
    page.keyboard.press("Delete")
    assert [float(value.split()[0]) for value in values(page)] == [second]


def test_the_area_of_an_ellipse_and_its_circumference(page: Any) -> None:
    page.keyboard.press("o")
    drag(page, at(page, -9, 20), at(page, 9, 20))
    drag(page, at(page, 0, 29), at(page, 0, 24))  # from a circle of 9 mm to a half axis of 4 mm
    area, circumference = (float(part) for part in values(page)[0].split() if part[0].isdigit())
    assert area == pytest.approx(math.pi * 9 * 4, abs=0.1 * math.pi * (9 + 4) / 2)
    assert circumference == pytest.approx(42.3656, abs=0.5)  # SciPy: 4 a E(1 - b²/a²)
    page.keyboard.press("x")
    assert values(page) == []
    page.keyboard.press("x")
    assert len(values(page)) == 1  # and back
    page.get_by_role("button", name="Remove ").click()
    assert values(page) == []
    page.keyboard.press("Control+z")
    assert len(values(page)) == 1


@pytest.mark.parametrize("tool", ["Distance", "Ellipse"])
def test_measures_are_put_and_moved_by_keys_alone(page: Any, tool: str) -> None:
    page.get_by_role("button", name=tool, exact=True).focus()
    page.keyboard.press("Enter")
    for key in ("ArrowUp", "Shift+ArrowLeft", "Tab", "ArrowDown"):
        page.keyboard.press(key)
    page.keyboard.press("Shift+ArrowRight")
    box = page.evaluate("document.querySelector('.us-image').getBoundingClientRect().toJSON()")
    pixel = 40 / box["width"]  # mm
    length = math.hypot(8 + 20 * pixel, 2 * pixel)
    shown = {"Distance": length, "Ellipse": math.pi * length**2 / 4}[tool]
    (value,) = values(page)
    assert float(value.split()[0]) == pytest.approx(shown, rel=0.01)
    focused = page.evaluate("document.activeElement.getAttribute('aria-label')")
    assert focused == f"Point 2 of measure 1: {value}"
    page.keyboard.press("Delete")
    assert values(page) == []
    page.keyboard.press("t")
    page.keyboard.press("Enter")
    page.keyboard.type("vein")
    page.keyboard.press("Enter")
    assert values(page) == ["vein"]


def test_frozen_the_page_takes_no_image_and_goes_through_the_last(
    page: Any, images: Images
) -> None:
    for grey in range(41, 51):
        images.show(grey)
        await_grey(page, grey)
    page.keyboard.press(" ")
    until(lambda: not images.feed.is_watched, "the page takes no image")
    assert page.locator("#readout").inner_text() == "frozen"
    images.show(99)
    for _ in range(3):
        page.keyboard.press(",")
    await_grey(page, 47)
    scrubber = page.locator(".us-scrubber")
    scrubber.evaluate("s => { s.value = 0; s.dispatchEvent(new Event('input')); }")
    await_grey(page, 40)
    assert page.locator(".us-moment").inner_text().startswith("-")
    page.keyboard.press("c")
    await_grey(page, 50)  # it plays to the end, and again
    page.keyboard.press(" ")
    until(lambda: images.feed.is_watched, "the page takes images again")
    images.show(120)
    await_grey(page, 120)


def test_a_measure_is_seen_with_its_frame_only(page: Any, images: Images) -> None:
    other = [*MATRIX[:9], 2 * DOWN, *MATRIX[10:]]  # as deep again
    images.show(41, matrix=other)
    await_grey(page, 41)
    images.show(42)
    await_grey(page, 42)
    page.keyboard.press("d")
    images.show(43)
    drag(page, at(page, 0, 10), at(page, 0, 30))  # of 42: who takes a tool freezes
    assert values(page) == ["20.0 mm"]
    page.keyboard.press(",")
    await_grey(page, 41)
    assert values(page) == []
    page.keyboard.press("d")
    drag(page, at(page, 0, 10), at(page, 0, 30))
    assert values(page) == ["40.0 mm"]
    page.keyboard.press(".")
    await_grey(page, 42)
    assert values(page) == ["20.0 mm"]
    page.keyboard.press(" ")
    await_grey(page, 43)  # or 44 might come in its place
    images.show(44)
    await_grey(page, 44)
    assert values(page) == []
    assert page.locator(".us-handle").count() == 0
    page.keyboard.press(" ")
    for grey in (43, 42):
        page.keyboard.press(",")
        await_grey(page, grey)
    assert values(page) == ["20.0 mm"]


def test_flipped_the_mark_is_right_and_measures_are_where_they_are_seen(
    page: Any, images: Images, tmp_path: Path
) -> None:
    mark = page.locator(".us-mark")
    image = page.locator(".us-image").bounding_box()
    middle = image["x"] + image["width"] / 2
    assert mark.bounding_box()["x"] < middle
    flipped = [-ACROSS, 0, 0, 0.02 - ACROSS, *MATRIX[4:]]
    images.show(41, matrix=flipped)
    until(lambda: mark.bounding_box()["x"] > middle, "the mark is at the other side")
    page.keyboard.press("d")
    drag(page, at(page, -15, 10), at(page, -5, 20))  # at the left
    assert values(page) == ["14.1 mm"]
    points = f"import('{TOOLS}/overlay.js').then(m => m.overlay.measures[0].points)"
    assert page.evaluate(points)[0] == pytest.approx([15, 10], abs=0.3)
    handle = page.locator(".us-handle").first.bounding_box()
    assert handle["x"] + handle["width"] / 2 == pytest.approx(at(page, -15, 10)[0], abs=1)
    with page.expect_download() as download:
        page.keyboard.press("p")
    download.value.save_as(tmp_path / "flipped.png")
    yellow = (cv2.imread(str(tmp_path / "flipped.png")) == (0x66, 0xD1, 0xFF)).all(axis=2)
    assert np.flatnonzero(yellow[:800].any(axis=0)).max() < 0.5 * yellow.shape[1]


def test_the_loop_keeps_ten_seconds_and_no_more_than_its_bytes(page: Any) -> None:
    kept = page.evaluate(
        f"""() => import('{TOOLS}/cine.js').then(({{ Cine }}) => {{
            const slow = new Cine(), large = new Cine();
            const frame = (i, byteLength, time) =>
                ({{ header: {{ i }}, payload: {{ byteLength }}, time }});
            for (let i = 0; i < 900; i++) slow.keep(frame(i, 100, i * 1000 / 30));
            for (let i = 0; i < 200; i++) large.keep(frame(i, 2 ** 20, i));
            const told = c => [c.frames.length, c.frames[0].header.i, c.bytes, c.duration];
            return [told(slow), told(large), slow.at(5000), slow.at(-1), slow.at(1e9)];
        }})"""
    )
    slow, large, *numbers = kept
    assert slow == [301, 599, 30100, pytest.approx(10_000)]
    assert large == [96, 104, 96 * 2**20, 95]
    assert numbers == [150, 0, 300]


KEPT = f"import('{TOOLS}/freeze.js').then(m => m.freeze.cine.frames.map(f => f.payload[0]))"


def test_the_loop_has_no_image_that_was_taken_long_before_the_others(
    page: Any, images: Images
) -> None:
    def show(grey: int, second: float) -> None:
        images.show(grey, stamp=str(round(second * 1e9)))
        await_grey(page, grey)

    show(54, 54)  # the first was taken before another mode was chosen
    assert page.evaluate(KEPT) == [54]
    show(55, 55)
    show(41, 41)  # and so was this, sent again as the mode is chosen
    show(56, 56)
    assert page.evaluate(KEPT) == [54, 55, 56]


def test_of_another_scene_no_image_is_kept_frozen_or_on_the_plane(
    page: Any, images: Images, sources: PageSources
) -> None:
    def scene(name: str) -> None:
        sources.session.state = SessionState(is_there=True, scene=name)
        page.locator(f"#us-scene[data-scene={name}]").wait_for(state="attached")

    plane = "import('/us_sim/assets/scene/probe.js').then(m => m.probe.image.visible)"
    frozen = f"import('{TOOLS}/freeze.js').then(m => m.freeze.isFrozen)"
    scene("upper_arm")
    images.show(41, scene="upper_arm")
    await_grey(page, 41)
    page.keyboard.press(" ")
    assert page.evaluate(frozen)
    assert page.evaluate(plane)
    scene("neck")
    until(lambda: not page.evaluate(frozen), "the old scene's image is let go")
    assert not page.evaluate(plane)
    images.show(43, scene="neck")
    await_grey(page, 43)
    until(lambda: page.evaluate(plane), "the new scene's image is on the plane")
    assert page.evaluate(KEPT) == [43]


def test_the_kept_picture_has_the_image_its_scale_and_the_values(
    page: Any, images: Images, tmp_path: Path
) -> None:
    images.show(40, press=0.0042, force=3.14, scene="upper_arm", settings={"gain": "6 dB"})
    shown = "import('/us_sim/assets/image.js').then(m => m.frameShown())"
    until(lambda: page.evaluate(f"{shown}.then(frame => frame.header.press)"), "the newer one")
    assert page.locator(".us-facts").inner_text() == "press 4.2 mm · force 3.1 N"
    page.keyboard.press("d")
    images.show(80, press=0.02, force=99)  # which is not the one that is measured
    drag(page, at(page, -10, 20), at(page, 10, 20))
    with page.expect_download() as download:
        page.keyboard.press("p")
    name = download.value.suggested_filename
    when = page.evaluate("new Date(40000).toLocaleString('sv-SE').replace(/[^0-9]+/g, '-')")
    assert name == f"us_sim-{when}-000.png"
    pressed, others = page.locator(".us-facts > *").all_inner_texts()
    assert pressed == "press 4.2 mm · force 3.1 N"
    assert others.split(" · ")[1:] == ["depth 42.0 mm", "gain 6 dB"]
    file = tmp_path / name
    download.value.save_as(file)
    picture = cv2.imread(str(file))
    grey = (picture == 40).all(axis=2)
    rows, columns = np.flatnonzero(grey.any(axis=1)), np.flatnonzero(grey.any(axis=0))
    shape = (columns[-1] - columns[0] + 1) / (rows[-1] - rows[0] + 1)
    assert shape == pytest.approx(COLUMNS * ACROSS / (ROWS * DOWN), rel=0.01)
    scale = (rows[-1] - rows[0] + 1) / (1e3 * ROWS * DOWN)  # pixels a mm
    yellow = (picture == (0x66, 0xD1, 0xFF)).all(axis=2)
    line = yellow[: rows[-1]]
    ends = np.flatnonzero(line.any(axis=0))
    assert (ends[-1] - ends[0]) / scale > 20  # the crosses, and the number, reach beyond
    assert np.argmax(line.sum(axis=1)) == pytest.approx(rows[0] + 20 * scale, abs=2)
    assert yellow[rows[-1] + 1 :].any()  # the value, below
    assert (picture[: rows[0]].max(axis=2) > 150).any()  # scene and time, above


def test_an_image_is_compared_with_those_that_come_as_it_is_seen_and_saved(
    page: Any, images: Images, tmp_path: Path
) -> None:
    def seen() -> int:
        """The grey value at the image's middle, as the page is painted."""
        box = page.locator(".us-image").bounding_box()
        clip = {"x": box["x"] + 99, "y": box["y"] + 99, "width": 2, "height": 2}
        encoded = np.frombuffer(page.screenshot(clip=clip), np.uint8)
        return int(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)[0, 0])

    until(lambda: seen() == 40, "the image is seen")
    page.get_by_role("button", name="Compare").click()
    until(lambda: seen() == 0, "it does not differ from itself")
    images.show(100)
    until(lambda: seen() == 60, "how far they are apart is seen")
    assert "difference from" in page.locator(".us-facts").inner_text()
    with page.expect_download() as download:
        page.keyboard.press("p")
    download.value.save_as(tmp_path / "difference.png")
    assert (cv2.imread(str(tmp_path / "difference.png"))[400, 400] == 60).all()
    images.show(101, matrix=[*MATRIX[:9], 2 * DOWN, *MATRIX[10:]])
    until(lambda: seen() == 101, "an image of other places is not compared")
    images.show(102)
    until(lambda: seen() == 62, "and the next again is")
    page.keyboard.press("v")
    until(lambda: seen() == 102, "it is compared no more")
    assert page.locator(".us-facts").inner_text() == ""


def show_annotated(page: Any, sources: PageSources, columns: int, rows: int) -> None:
    """A picture in colour in place of the image, as wide and high as that."""
    encoded = cv2.imencode(".jpg", np.full((rows, columns, 3), 90, np.uint8))[1].tobytes()
    feed = Feed("annotated", rate=None)
    header = {"stamp": str(41 * 10**9), "rows": rows, "columns": columns, "encoding": "jpeg"}
    header["matrix"] = MATRIX
    feed.offer_packet(lambda n: Packet("annotated", n, header, encoded))
    sources.add_feeds(feed)
    page.evaluate("import('/us_sim/assets/image.js').then(m => m.setMode('annotated'))")
    page.wait_for_function(
        f"""() => {{
            const canvas = document.querySelector(".us-image");
            const [red, green] = canvas.getContext("2d").getImageData(9, 9, 1, 1).data;
            return canvas.width === {columns} && Math.abs(red - 90) < 3 && red === green;
        }}"""
    )


def test_the_annotated_picture_is_measured_as_the_image_below_it(
    page: Any, sources: PageSources
) -> None:
    page.keyboard.press("d")
    drag(page, at(page, -8, 5), at(page, 4, 5))
    lengths = values(page)
    page.keyboard.press(" ")
    show_annotated(page, sources, COLUMNS, ROWS)
    page.get_by_role("button", name="Distance", exact=True).click()
    drag(page, at(page, 0, 6), at(page, 0, 33))
    lengths += values(page)
    assert [float(each.split()[0]) for each in lengths] == pytest.approx([12, 27], abs=0.1)
    scale = page.locator(".us-scale")
    assert not scale.is_visible()  # that picture has scales of its own
    page.keyboard.press(",")  # the image before it, which has not
    scale.wait_for()


def test_a_picture_of_another_size_is_not_measured_and_says_why(
    page: Any, sources: PageSources
) -> None:
    button = page.get_by_role("button", name="Distance", exact=True)
    show_annotated(page, sources, 80, 60)
    until(button.is_disabled, "distances cannot be measured")
    assert "another size than the B-mode image" in button.get_attribute("title")
    page.keyboard.press("d")
    drag(page, (900, 300), (1000, 300))
    assert values(page) == []


def test_the_last_seconds_are_saved_as_they_are_seen(
    page: Any, images: Images, tmp_path: Path
) -> None:
    for second, grey in ((41, 80), (42, 120)):
        images.show(grey, stamp=str(second * 10**9))
        await_grey(page, grey)
    page.locator(".us-kinds").select_option("mp4")
    with page.expect_download() as download:
        page.keyboard.press("p")
    assert download.value.suggested_filename.endswith(".mp4")
    page.get_by_role("button", name="Freeze").wait_for()  # the page goes on
    file = tmp_path / "loop.mp4"
    download.value.save_as(file)
    shown, picture = cv2.VideoCapture(str(file)).read()
    assert shown
    assert picture[200, 200].tolist() == pytest.approx([40] * 3, abs=4)


def test_a_strip_is_frozen_with_the_image_and_saved_below_it(
    page: Any, sources: PageSources, tmp_path: Path
) -> None:
    feed = Feed("m_mode", rate=None)
    sources.add_feeds(feed)

    def show(blue: int) -> None:
        strip = np.full((60, 300, 3), (blue, 20, 20), np.uint8)
        encoded = cv2.imencode(".jpg", strip)[1].tobytes()
        header = {"stamp": "1", "rows": 60, "columns": 300, "encoding": "jpeg"}
        feed.offer_packet(lambda n: Packet("m_mode", n, header, encoded))

    show(200)
    page.evaluate("import('/us_sim/assets/strips.js').then(m => m.showStrip('m_mode', true))")
    drawn = """blue => {
        const strip = document.querySelector(".us-strip");
        const found = strip?.getContext("2d").getImageData(9, 9, 1, 1).data[2] ?? 0;
        return Math.abs(found - blue) < 8;
    }"""
    page.wait_for_function(drawn, arg=200)
    page.keyboard.press(" ")
    show(90)
    with page.expect_download() as download:
        page.keyboard.press("p")
    download.value.save_as(tmp_path / "still.png")
    blue = cv2.imread(str(tmp_path / "still.png"))[:, 300].astype(int)
    below = np.flatnonzero(np.abs(blue - (200, 20, 20)).max(axis=1) < 8)
    grey = np.flatnonzero((blue == 40).all(axis=1))
    assert below.size > 100  # as wide as the image
    assert below.min() > grey.max()
    page.keyboard.press(" ")
    show(91)
    page.wait_for_function(drawn, arg=91)
