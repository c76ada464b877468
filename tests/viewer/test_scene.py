"""The 3D scene in a real browser: what is seen where, and what the pointer meets."""

import io
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from us_sim.geometry.collider import RoundedBox
from us_sim.geometry.transducer import build_transducer_mesh
from us_sim.skin.surface import plane_surface
from us_sim.slicing.probe.probe import LinearProbe, compute_image_outline
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.viewer.stream import Feed, Packet, PageSources
from us_sim.viewer.surfaces import (
    CarriedSurfaces,
    ColouredSurface,
    StreamedSurface,
    make_transducer_packet,
)

LIMIT_MS = 60_000
SCENE = "import('/us_sim/assets/scene/scene.js')"
VEIN, ARTERY = [0.0, 0.0, 0.015], [0.025, 0.0, 0.015]
MESH = box_mesh(*(uniform_planes(-0.05, 0.05, 5),) * 2, uniform_planes(0.0, 0.04, 4))
SKIN = plane_surface((0.12, 0.12), 0.01)
PROBE = LinearProbe(aperture=0.04, depth=0.03, columns=64, rows=48)


def cube(name: str, colour: tuple[float, float, float], middle: list[float]) -> ColouredSurface:
    """Of 12 mm."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = np.array([t for a, b, c, d in faces for t in ([a, b, c], [a, c, d])])
    return ColouredSurface(name, colour, 0.006 * signs + np.array(middle), triangles)


class Patient:
    """Feeds of a flat skin over tissue with two cubes in it, and a probe beside."""

    def __init__(self, sources: PageSources) -> None:
        faces = MESH.boundary
        edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        self.tissue = StreamedSurface(MESH.nodes, faces, edges)
        self.skin = StreamedSurface(SKIN.vertices, SKIN.triangles)
        cubes = [cube("vein", (0.25, 0.4, 0.85), VEIN), cube("artery", (0.85, 0.15, 0.15), ARTERY)]
        structures = CarriedSurfaces(MESH, cubes)
        collider = RoundedBox(length=0.046, width=0.014, height=0.04, rounding=0.004)
        parts = [
            ColouredSurface(part.name, part.colour, part.vertices, part.triangles)
            for part in build_transducer_mesh(collider)
        ]
        kinds = [
            "skin_mesh",
            "skin",
            "tissue_mesh",
            "tissue",
            "strain",
            "structures",
            "probe_mesh",
            "probe",
        ]
        self.feeds = {kind: Feed(kind) for kind in [*kinds, "image", "score"]}
        sources.add_feeds(*self.feeds.values())
        self._offer("skin_mesh", lambda n: self.skin.make_rest_packet("skin_mesh", n))
        self._offer("tissue_mesh", lambda n: self.tissue.make_rest_packet("tissue_mesh", n))
        self._offer(
            "structures", lambda n: structures.make_rest_packet("structures", n, self.tissue.number)
        )
        outline = compute_image_outline(PROBE)
        self._offer("probe_mesh", lambda n: make_transducer_packet("probe_mesh", n, parts, outline))
        self.show(200)
        self.push()
        self.move(np.zeros(3))

    def push(self, stamp: int = 0, force_stamp: int = 0, age: float = 0.0) -> None:
        """The probe with the force on it, of stamps in ns."""
        pose = {"stamp": str(stamp), "position": [0, 0.04, 0], "quaternion": [0, 0, 0, 1]}
        pushed = pose | {"force": [0.0, 0.0, -2.5], "torque": [0.0, 0.0, 0.0]}
        pushed |= {"force_stamp": str(force_stamp), "force_age": age}
        self._offer("probe", lambda n: Packet("probe", n, pushed, b""))

    def move(self, shift: np.ndarray, stamp: int = 0) -> None:
        """All tissue from rest, m."""
        moved = MESH.nodes + shift
        self._offer(
            "tissue",
            lambda n: self.tissue.make_packet(moved, kind="tissue", sequence=n, stamp=stamp),
        )

    def dent(self, vertices: np.ndarray) -> None:
        """The skin elsewhere than at rest."""
        self._offer(
            "skin", lambda n: self.skin.make_packet(vertices, kind="skin", sequence=n, stamp=0)
        )

    def strain(self, values: np.ndarray) -> None:
        """Of each node."""
        header = {"stamp": "0", "mesh": self.tissue.number, "points": len(values)}
        self._offer("strain", lambda n: Packet("strain", n, header, values.tobytes()))

    def show(self, grey: int, stamp: int = 0) -> None:
        """An image all in one grey, 0 to 255."""
        header = {"stamp": str(stamp), "rows": 48, "columns": 64, "encoding": "mono8"}
        header["matrix"] = PROBE.image_to_probe.ravel().tolist()
        self._offer("image", lambda n: Packet("image", n, header, bytes([grey]) * (48 * 64)))

    def _offer(self, kind: str, pack: Callable[[int], Packet]) -> None:
        self.feeds[kind].offer_packet(pack)


@pytest.fixture
def scene_of(page: Any, sources: PageSources) -> Callable[[], SimpleNamespace]:
    """Loads the page with a patient in it, seen from above."""
    patient = Patient(sources)
    return lambda: opened(page, patient)


@pytest.fixture
def scene(scene_of: Callable[[], SimpleNamespace]) -> SimpleNamespace:
    """The page with a patient in it, seen from above."""
    return scene_of()


def opened(page: Any, patient: Patient) -> SimpleNamespace:
    """The page as it is when all has come, and what can be asked of it."""
    page.emulate_media(reduced_motion="reduce")  # views change at once
    page.goto(page.address)
    page.wait_for_selector(".us-scene-canvas", timeout=LIMIT_MS)
    page.evaluate(f"async () => {{ window.scene = await {SCENE}; }}")

    def ask(script: str) -> Any:
        return page.evaluate(f"async () => {{ const scene = await {SCENE}; {script} }}")

    def until(condition: str) -> None:
        """Wait until it holds; it is a function of the module `scene`.

        What is waited for is no promise, which would count as true at once.
        """
        page.wait_for_function(
            f"() => {{ const {{ scene }} = window; return {condition}; }}", timeout=LIMIT_MS
        )

    def place(point: list[float]) -> tuple[float, float]:
        """Where on the page a point of the patient is."""
        x, y = ask(
            f"""const {{ stage }} = scene;
            const {{ x, y }} = stage.project(new stage.THREE.Vector3(...{point}));
            const box = stage.canvas.getBoundingClientRect();
            return [x + box.x, y + box.y];"""
        )
        return x, y

    def pixel(point: list[float]) -> np.ndarray:
        """Red, green, blue of a point of the patient, as seen."""
        x, y = place(point)
        clip = {"x": x - 1, "y": y - 1, "width": 3, "height": 3}
        picture = Image.open(io.BytesIO(page.screenshot(clip=clip, timeout=LIMIT_MS)))
        return np.asarray(picture.convert("RGB"), dtype=float).reshape(-1, 3).mean(axis=0)

    def becomes(point: list[float], holds: Callable[[np.ndarray], bool]) -> np.ndarray:
        colour = np.zeros(3)
        deadline = time.monotonic() + 40.0
        while time.monotonic() < deadline:
            colour = pixel(point)
            if holds(colour):
                return colour
        pytest.fail(f"the pixel at {point} is {colour}")

    # The hand's panel takes room from the scene.
    page.wait_for_selector("#hand button:visible", timeout=LIMIT_MS)
    until("scene.stage.scene.getObjectByName('vein') && scene.stage.pace.drawn > 0")
    until(
        "Math.abs(scene.stage.canvas.height / scene.stage.pace.ratio"
        " - scene.stage.place.clientHeight) < 2"
    )
    ask("scene.view('top')")
    until("Math.hypot(scene.stage.camera.position.x, scene.stage.camera.position.y) < 0.05")
    return SimpleNamespace(
        page=page, patient=patient, ask=ask, until=until, place=place, becomes=becomes
    )


GREY = """document.querySelector(".us-image").getContext("2d").getImageData(9, 9, 1, 1).data[0]"""
"""Of a pixel of the ultrasound image, as drawn."""


def is_blue(colour: np.ndarray) -> bool:
    return bool(colour[2] > colour[0] + 40)


def is_red(colour: np.ndarray) -> bool:
    return bool(colour[0] > colour[1] + 60 and colour[0] > colour[2] + 60)


def is_dark(colour: np.ndarray) -> bool:
    return bool(colour.max() < 40)


def test_structures_are_seen_where_they_are_in_their_colours(scene):
    scene.ask("for (const name of ['skin', 'probe', 'force']) scene.setVisible(name, false)")
    scene.becomes(VEIN, is_blue)
    scene.becomes(ARTERY, is_red)
    scene.becomes([-0.03, 0.0, 0.015], is_dark)
    scene.ask("scene.setVisible('vein', false)")
    scene.becomes(VEIN, is_dark)
    scene.becomes(ARTERY, is_red)


def test_structures_go_with_the_tissue(scene):
    scene.ask("for (const name of ['skin', 'probe', 'force']) scene.setVisible(name, false)")
    scene.becomes(VEIN, is_blue)
    scene.patient.move(np.array([-0.03, 0.0, 0.0]))
    scene.becomes([-0.03, 0.0, 0.015], is_blue)
    scene.becomes([-0.005, 0.0, 0.015], is_red)
    scene.becomes([0.012, 0.0, 0.015], is_dark)


def test_targets_stand_on_the_skin_in_the_colours_of_their_states_and_move_with_it(scene):
    """The skin is at z = 0; of what is to do, the nearest to the probe at y = 40 mm is next.

    Numbers are in the middle of their dots, of the same colours; here they are hidden at first.
    """
    style = scene.page.add_style_tag(content=".us-number { visibility: hidden }")
    for name in ("image", "structures", "force"):
        scene.ask(f"scene.setVisible('{name}', false)")
    states = {-0.04: "done", -0.02: "missed", 0.0: "to do", 0.02: "to do"}
    places = [([-0.015, y, 0.013], state) for y, state in states.items()]
    places.append(([0.0, 0.04, 0.013], "done"))  # which the probe hides
    steps = [
        {"what": f"{number}: vein", "seen": "open", "state": state, "target": [place]}
        for number, (place, state) in enumerate(places, 1)
    ]
    score = scene.patient.feeds["score"]
    score.offer_packet(lambda n: Packet("score", n, {"scene": "", "steps": steps}, b""))

    def stands(y: float, z: float = 0.0) -> list[float]:
        return [-0.015, y, z]  # between vertices of the skin

    scene.becomes(stands(-0.04), lambda c: c[1] > c[0] + 60 and c[1] > c[2] + 40)  # green
    scene.becomes(stands(-0.02), lambda c: c[0] > c[2] + 80 and c[0] > c[1] + 80)  # red
    scene.becomes(stands(0.0), lambda c: c.min() > 200)  # white
    scene.becomes(stands(0.02), lambda c: c[2] > c[0] + 100 and c[2] > c[1] + 50)  # blue
    assert scene.page.locator(".us-task").inner_text() == "4: vein: open"
    again = [{**step, "seen": "closed"} for step in steps]
    score.offer_packet(lambda n: Packet("score", n, {"scene": "", "steps": again}, b""))
    scene.page.get_by_text("4: vein: closed").wait_for()
    style.evaluate("style => style.remove()")
    scene.until("scene.stage.pace.isAtRest")  # the page may have been laid out anew
    numbers = scene.page.locator(".us-number:not(.us-behind)")
    assert numbers.all_inner_texts() == ["1", "2", "3", "4"]
    assert scene.page.locator(".us-behind").inner_text() == "5"
    colours = numbers.evaluate_all("all => all.map((each) => each.style.background)")
    assert len(set(colours)) == 4
    for number, y in zip(numbers.all(), states, strict=True):
        box = number.bounding_box()
        middle = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
        assert middle == pytest.approx(scene.place(stands(y)), abs=1.0)
    scene.page.add_style_tag(content=".us-number { visibility: hidden }")
    scene.becomes([0.0, 0.04, 0.0], lambda c: not (c[1] > c[0] + 60))
    slope = np.outer(SKIN.vertices[:, 0] + 0.015, [0.0, 0.0, 1.0])
    scene.patient.dent(SKIN.vertices + slope + [0.0, 0.0, 0.01])
    scene.ask("scene.setVisible('probe', false); scene.view('front')")
    scene.becomes(stands(0.02, 0.0095), lambda c: c[2] > c[0] + 100 and c[2] > c[1] + 50)
    scene.ask("scene.setVisible('targets', false)")
    scene.becomes(stands(0.02, 0.0095), lambda c: not (c[2] > c[0] + 60))


def test_the_pointer_meets_the_skin_and_its_normal(scene):
    x, y = scene.place([-0.02, -0.03, 0.0])
    hit = scene.ask(f"return scene.pick({{ clientX: {x}, clientY: {y} }})")
    assert hit["object"] == "skin"
    assert hit["point"] == pytest.approx([-0.02, -0.03, 0.0], abs=5e-4)
    assert hit["normal"] == pytest.approx([0, 0, -1], abs=1e-6)
    assert scene.ask("return scene.pick({ clientX: 4, clientY: 300 })") is None


def test_colours_of_the_tissue_have_a_bar_with_a_unit_and_strain_is_asked_for_only_then(scene):
    feeds = scene.patient.feeds
    bar = scene.page.locator(".us-colour-bar")
    assert not bar.is_visible()
    assert not feeds["strain"].is_watched
    scene.page.click("text=Layers")
    scene.page.click("[data-tissue=displacement]")
    bar.wait_for(state="visible", timeout=LIMIT_MS)
    scene.patient.move(np.array([0.0, 0.0, 0.0042]))
    scene.page.wait_for_function(
        "() => document.querySelector('.us-colour-bar').innerText.includes('5')", timeout=LIMIT_MS
    )
    assert "Displacement (mm)" in bar.inner_text()
    scene.page.click("[data-tissue=strain]")
    for _ in range(200):
        if feeds["strain"].is_watched:
            break
        scene.page.wait_for_timeout(50)
    assert feeds["strain"].is_watched
    # One crushed node of the surface does not make all others look unstrained.
    strains = np.linspace(0.0, 0.04, len(MESH.nodes), dtype=np.float32)
    strains[0] = 0.9
    scene.patient.strain(strains)
    scene.page.wait_for_function(
        "() => document.querySelector('.us-colour-bar').innerText.trim().endsWith('5')",
        timeout=LIMIT_MS,
    )
    scene.page.click("[data-tissue=off]")
    bar.wait_for(state="hidden", timeout=LIMIT_MS)


def test_along_the_patient_it_is_the_right_way_up(scene):
    scene.ask("for (const name of ['skin', 'probe', 'force']) scene.setVisible(name, false)")
    scene.patient.move(np.array([0.0, 0.03, 0.0]))
    scene.becomes([0.0, 0.03, 0.015], is_blue)
    scene.becomes([0.0, -0.03, 0.015], is_dark)


HARDWARE = """const { getParameter } = WebGL2RenderingContext.prototype;
WebGL2RenderingContext.prototype.getParameter = function (name) {
    return name === 0x9246 ? "a graphics card" : getParameter.call(this, name);
};"""
"""Has the browser say that a graphics card draws (UNMASKED_RENDERER_WEBGL)."""


def test_with_a_graphics_card_it_looks_the_same_and_is_drawn_into_the_page(page, scene_of):
    seen = scene_of()
    seen.ask("for (const name of ['skin', 'probe', 'force']) scene.setVisible(name, false)")
    seen.until("scene.stage.pace.isAtRest")
    read = [seen.becomes(VEIN, is_blue), seen.becomes(ARTERY, is_red)]
    page.add_init_script(HARDWARE)
    seen = scene_of()
    assert not seen.ask("return scene.stage.pace.isSlow")
    assert seen.ask("return scene.stage.canvas.getContext('webgl2') !== null")
    seen.ask("for (const name of ['skin', 'probe', 'force']) scene.setVisible(name, false)")
    seen.until("scene.stage.pace.isAtRest")
    drawn = [seen.becomes(VEIN, is_blue), seen.becomes(ARTERY, is_red)]
    page.close()  # no other test has that card
    np.testing.assert_allclose(read, drawn, atol=12)


def test_nothing_is_drawn_while_nothing_changes(scene):
    scene.patient.show(90)
    scene.page.wait_for_function(f"{GREY} === 90")
    scene.until("scene.stage.pace.isAtRest")
    drawn = scene.ask("return scene.stage.pace.drawn")
    for _ in range(3):
        images = scene.page.evaluate("window.usSim.images()")
        scene.patient.show(90)
        scene.page.wait_for_function("(before) => window.usSim.images() > before", arg=images)
    assert scene.ask("return [scene.stage.pace.isAtRest, scene.stage.pace.drawn]") == [True, drawn]
    scene.page.wait_for_timeout(600)  # twice as long as what moves counts as moving
    assert scene.ask("return scene.stage.pace.drawn") == drawn
    scene.patient.show(200)
    scene.until(f"scene.stage.pace.drawn > {drawn}")


def test_what_is_older_than_the_image_is_marked_until_it_is_not(
    page: Any, scene: SimpleNamespace
) -> None:
    patient, old = scene.patient, page.locator(".us-scene-old")
    force = page.locator(".us-force")
    noon = 1_790_000_000_000_000_000
    patient.show(90, noon)
    patient.push(noon, noon)
    patient.move(np.zeros(3), noon)
    scene.page.wait_for_function("() => window.usSim.images() > 0")
    old.wait_for(state="hidden")  # what was seen at first is drawn late on a busy computer
    patient.show(95, noon + 400_000_000)
    page.wait_for_timeout(600)
    old.wait_for(state="hidden")  # likewise
    later = noon + 1_300_000_000
    patient.show(99, later)
    page.get_by_text("The 3D view is 1.3 s older than the image").wait_for()
    patient.move(np.zeros(3), later)
    patient.push(later, noon)
    page.get_by_text("The force is 1.3 s older than the image").wait_for()
    assert "us-old" in (force.get_attribute("class") or "")
    patient.push(later, noon, age=1.3)
    page.get_by_text("No force for 1.3 s: the tissue is not in balance").wait_for()
    assert "us-old" in (force.get_attribute("class") or "")
    patient.push(later, later)
    old.wait_for(state="hidden")
    assert "us-old" not in (force.get_attribute("class") or "")
