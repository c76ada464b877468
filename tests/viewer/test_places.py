"""The colour box, the gate and the line of M-mode are dragged over the image to where they look."""

from typing import Any

import numpy as np
import pytest
from awaiting import until
from fake_nodes import FakeNodes

from us_sim.slicing.probe.beams import convert_to_pixels
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, compute_image_outline
from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.stream import Feed, Packet, PageSources
from us_sim.viewer.surfaces import make_transducer_packet

NODE = "slice_interpolator"
LINEAR = LinearProbe(aperture=0.04, depth=0.04, columns=200, rows=200)
CONVEX = ConvexProbe(radius=0.05, opening_angle=1.0, depth=0.08, columns=200, rows=200)
BUTTONS = {"colour": "Outlines", "spectrum": "Spectrum", "m_mode": "M-mode"}


class Node:
    """The simulator's part: parameters that are set, and a picture of a probe."""

    def __init__(self, sources: PageSources, probe: Probe, steering: float, flip: bool) -> None:
        self.values: dict[str, Any] = {"depth": probe.depth, "overlay": "velocity"}
        for kind in ("colour", "spectrum"):
            self.values |= {f"{kind}.lateral": 0.1, f"{kind}.depth": 0.02}
            self.values[f"{kind}.steering"] = steering
        self.values |= {"colour.width": 0.4, "colour.height": 0.01, "spectrum.size": 0.002}
        self.values["m_mode.lateral"] = 0.1
        sources.nodes = self._nodes = FakeNodes(self._take)
        self._tell()
        matrix = probe.image_to_probe.copy()
        if flip:
            matrix[0] *= -1
        header = {"matrix": matrix.ravel().tolist()}
        header |= {"stamp": "1", "rows": probe.rows, "columns": probe.columns}
        outline = compute_image_outline(probe)
        packets = {
            "probe_mesh": lambda n: make_transducer_packet("probe_mesh", n, [], outline),
            "image_geometry": lambda n: Packet("image_geometry", n, header, b""),
            "image": lambda n: Packet(
                "image", n, header | {"encoding": "mono8"}, bytes(probe.rows * probe.columns)
            ),
        }
        for kind, pack in packets.items():
            sources.add_feeds(Feed(kind))
            sources.feeds[kind].offer_packet(pack)

    def _tell(self) -> None:
        made = []
        for name, value in self.values.items():
            kind = ParameterKind.TEXT if isinstance(value, str) else ParameterKind.NUMBER
            size = 1e-3 if name.endswith(("depth", "height", "size")) else 1.0
            made.append(Parameter(NODE, name, kind, value, size=size))
        self._nodes.tell(*made)

    def _take(self, parameter: Parameter, raw: Any) -> str:
        self.values[parameter.name] = raw
        self._tell()
        return ""


@pytest.mark.parametrize(
    ("kind", "probe", "steering", "flip"),
    [
        ("colour", CONVEX, 0.0, True),
        ("spectrum", LINEAR, 0.3, True),
        ("m_mode", LINEAR, 0.0, True),
    ],
)
def test_what_is_dragged_looks_where_it_was_dragged_to(
    page: Any, sources: PageSources, kind: str, probe: Probe, steering: float, flip: bool
) -> None:
    node = Node(sources, probe, steering, flip)

    def place() -> np.ndarray:
        """Column and row where it looks."""
        depth = node.values.get(f"{kind}.depth", 0.5 * probe.depth)
        lateral = np.array([node.values[f"{kind}.lateral"]])
        leaning = steering if kind == "spectrum" else 0.0
        return convert_to_pixels(probe, lateral, np.array([depth]), leaning)[0]

    page.goto(page.address)
    page.wait_for_function("document.querySelector('.us-image')?.width === 200")
    page.get_by_role("button", name=BUTTONS[kind]).click()
    if kind == "colour":
        node.values["overlay"] = "velocity"
        node._tell()
    grip = page.locator(f"[data-place={kind}]")
    grip.wait_for(state="attached")
    at = grip.evaluate("e => { const p = e.getPointAtLength(8); return [p.x, p.y]; }")
    box = page.evaluate("document.querySelector('#ultrasound').getBoundingClientRect().toJSON()")
    canvas = page.evaluate("document.querySelector('.us-image').getBoundingClientRect().toJSON()")
    x, y = box["left"] + at[0], box["top"] + at[1]
    before = place()
    pixels = np.array([-24.0, 0.0 if kind == "m_mode" else 18.0])
    pixel = np.array([canvas["width"] / probe.columns, canvas["height"] / probe.rows])
    page.mouse.move(x, y)
    page.mouse.down()
    for part in (0.5, 1.0):
        page.mouse.move(*(np.array([x, y]) + part * pixel * pixels))
    page.mouse.up()
    wanted = before + pixels * ([-1, 1] if flip else [1, 1])
    until(lambda: np.abs(place() - wanted).max() < 0.6, "it looks where it was dragged", 9.0)
    lateral = node.values[f"{kind}.lateral"]
    sign = -1 if flip else 1

    def is_moved_by_key() -> bool:
        """Press a key, again where the grip was drawn anew meanwhile."""
        grip.press("ArrowLeft")
        return sign * (lateral - node.values[f"{kind}.lateral"]) > 0.005

    until(is_moved_by_key, "a key moves it", 9.0)
