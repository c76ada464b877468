"""Sources for pages whose hand only remembers what it was asked."""

import time
from typing import Any

import numpy as np

from us_sim.skin.surface import plane_surface
from us_sim.viewer.stream import Feed, Packet, PageSources
from us_sim.viewer.surfaces import ColouredSurface, StreamedSurface, make_transducer_packet

PIXEL = 8e-5  # m
FACE = [0.005, 0.01, 0.001]  # m, where the probe's face is
MATRIX = [PIXEL, 0, 0, -0.0128, 0, 0, 0, 0, 0, PIXEL, 0, PIXEL / 2, 0, 0, 0, 1]
RANGES = {"x": [-0.07, 0.07], "y": [-0.08, 0.08], "press": [-0.05, 0.025], "tilt": [-1.05, 1.05]}
STANCE = {"x": 0.012, "y": 0.0, "z": 0.0, "press": 0.0042, "rotation": 0.0, "fan": -0.2, "rock": 0}


class FakeHand:
    """Feeds ``image``, ``hand`` and ``score``, and the command ``hand``."""

    def __init__(self, sources: PageSources) -> None:
        self.asked: list[dict[str, Any]] = []
        self.image, self.state = Feed("image", rate=None), Feed("hand", rate=None)
        self.score = Feed("score", rate=None)
        sources.add_feeds(self.image, self.state, self.score)
        sources.commands["hand"] = self._take
        sources.commands["take"] = self._take_over
        self.takes: list[Any] = []  # pages that were to take the probe
        self.say()
        self.show()

    def _take(self, value: Any, _: int) -> str | None:
        self.asked.append(value)
        return "the hand cannot" if value.get("go") == "lift" else None

    def _take_over(self, source: Any, _: int) -> None:
        self.takes.append(source)

    def say(self, **changes: Any) -> None:
        header = {"leader": "hand", "holder": "", "can_take": False}
        header |= {"obstacle": "", "warning": ""}
        header["range"] = RANGES
        header |= {"stance": STANCE, "goal": STANCE, **changes}
        self.state.offer_packet(lambda n: Packet("hand", n, header, b""))

    def show(self, **told: Any) -> None:
        header = {"stamp": "1", "rows": 320, "columns": 320, "encoding": "mono8"}
        header |= {"matrix": MATRIX, **told}
        self.image.offer_packet(lambda n: Packet("image", n, header, bytes(320 * 320)))

    def total(self, name: str) -> Any:
        """The sum of all changes of a quantity."""
        changes = [wish["by"][name] for wish in self.asked if name in wish.get("by", {})]
        if name == "slide":
            return [sum(change[axis] for change in changes) for axis in (0, 1)]
        return sum(changes)

    def until(self, done: Any) -> None:
        deadline = time.monotonic() + 10.0
        while not done():
            assert time.monotonic() < deadline, f"asked so far: {self.asked}"
            time.sleep(0.02)


def show_patient(sources: PageSources) -> None:
    """Feed a flat piece of skin and a probe that stands on it."""
    skin, mesh, pose = (Feed(kind, rate=None) for kind in ("skin_mesh", "probe_mesh", "probe"))
    sheet = plane_surface((0.16, 0.16), 0.02)
    surface = StreamedSurface(sheet.vertices, sheet.triangles)
    skin.offer_packet(lambda n: surface.make_rest_packet("skin_mesh", n))
    body = ColouredSurface("body", (0.9, 0.9, 0.9), *_box([-0.02, -0.008, -0.12], [0.02, 0.008, 0]))
    outline = np.array([[-0.02, 0, 0], [0.02, 0, 0], [0.02, 0, 0.04], [-0.02, 0, 0.04]])
    mesh.offer_packet(lambda n: make_transducer_packet("probe_mesh", n, [body], outline))
    header = {"stamp": "1", "position": FACE, "quaternion": [0, 0, 0, 1]}
    pose.offer_packet(lambda n: Packet("probe", n, header, b""))
    sources.add_feeds(skin, mesh, pose)


def _box(lower: list[float], upper: list[float]) -> tuple[Any, Any]:
    """Corners (8, 3) m and triangles (12, 3) of a box, outwards."""
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"))
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    return corners.reshape(3, 8).T, np.array(triangles)
