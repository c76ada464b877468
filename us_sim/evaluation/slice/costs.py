"""What each probe's geometry and each setting of image formation adds to the time of an image."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from us_sim.evaluation.slice.cases import DEPTHS, MAIN
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.formation.coupling import ContactSurface
from us_sim.slicing.formation.image_formation import ImageFormation
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.settings import Imaging
from us_sim.volume.volume import Volume

_IMAGES, _QUICK_IMAGES = 60, 15
_LINEAR = LinearProbe(aperture=0.06, depth=0.08, columns=MAIN.size, rows=MAIN.size)
_PROBES: Mapping[str, Probe] = {
    "linear, 60 × 80 mm": _LINEAR,
    "convex, 40 mm radius, 60°": ConvexProbe(
        radius=0.04, opening_angle=math.radians(60), depth=0.08, columns=MAIN.size, rows=MAIN.size
    ),
    "sector, 90°": SectorProbe(
        aperture=0.02, opening_angle=math.radians(90), depth=0.08, columns=MAIN.size, rows=MAIN.size
    ),
}
_SETTINGS = {
    "all at their defaults": Imaging(),
    "gain": Imaging(gain=6.0),
    "time gain, dynamic range, grey map": Imaging(
        time_gain=(0.0, 3.0, 6.0), dynamic_range=50.0, grey_map="soft"
    ),
    "lateral and axial resolution": Imaging(lateral_resolution=1.5e-3, axial_resolution=0.5e-3),
    "contact": Imaging(contact=True),
    "5 elevation planes": Imaging(elevation_planes=5),
}


@dataclass(frozen=True)
class Cost:
    """One line of the table."""

    what: str
    ms: float  # of a whole image, processor time, median
    shown: float = 1.0  # part of the image's pixels that show something


def costs(volume: Volume, quick: bool) -> tuple[list[Cost], list[Cost]]:
    """Whole images in the main case on one thread: by probe, and by setting."""
    mesh = MAIN.mesh()
    frames = MAIN.frames(4)
    slicer = create_slicer("scan_conversion", volume, mesh.nodes, mesh.tetrahedra)
    surface = ContactSurface(mesh.nodes, mesh.boundary)
    pose = Pose(np.array([0.0, 0.0, DEPTHS[MAIN.deformation]]))

    def imaged(probe: Probe, imaging: Imaging) -> Callable[[int], object]:
        formation = ImageFormation(probe, imaging)

        def image(number: int) -> object:
            nodes = frames[number % len(frames)].nodes
            images = [slicer.image(nodes, plane) for plane in formation.planes(pose)]
            if not formation.needs_contact:
                return formation.form(images)
            return formation.form(images, *surface.contact(nodes, probe, pose))

        return image

    work = {name: imaged(probe, Imaging()) for name, probe in _PROBES.items()}
    work |= {name: imaged(_LINEAR, imaging) for name, imaging in _SETTINGS.items()}
    median = _medians(work, _QUICK_IMAGES if quick else _IMAGES)
    shown = {name: float(probe.plane(pose).is_shown().mean()) for name, probe in _PROBES.items()}
    probes = [Cost(name, median[name], shown[name]) for name in _PROBES]
    return probes, [Cost(name, median[name]) for name in _SETTINGS]


def _medians(work: Mapping[str, Callable[[int], object]], images: int) -> dict[str, float]:
    """ms of processor time each takes, all in turns; the first image of each is not counted."""
    found: dict[str, list[float]] = {name: [] for name in work}
    for number in range(images + 1):
        for name, image in work.items():
            before = time.process_time()
            image(number)
            found[name].append((time.process_time() - before) * 1e3)
    return {name: float(np.median(ms[1:])) for name, ms in found.items()}
