"""What an image costs with each part of its acoustics, in processor time of one thread."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import cv2
import numpy as np

from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.target import Target
from us_sim.geometry.pose import Pose
from us_sim.scene.building import probe_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.settings import Imaging
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes

_NODES = (32, 16, 16)  # 34,875 tetrahedra
_PRESS = 8e-3  # m
_IMAGES, _QUICK_IMAGES = 300, 60
_LIMIT = 1.5  # ms
_RATIO = 1.67  # that limit over the 0.9 ms of a slice, on the machine that it is asked for


class RunTime(Artefact):
    """Images of 512 × 512 of the pressed arm, in turn, so that all have the same disturbances."""

    name = "run_time"
    title = "Run time"
    simplified = (
        "nothing; other programs on the machine lengthen these times, and their ratio less."
    )

    def points(self, quick: bool) -> list[Point]:
        scene = load_scene("upper_arm")
        volume, probe = volume_of(scene), probe_of(scene).with_pixels(512, 512)
        full = scene.imaging.acoustics
        none = dataclasses.replace(full, surfaces=False, anisotropy=False, noise=None)
        kinds: dict[str, Acoustics | None] = {
            "slice": None,
            "loss": none,
            "loss_and_surfaces": dataclasses.replace(none, surfaces=True),
            "loss_and_fibres": dataclasses.replace(none, anisotropy=True),
            "all": full,
        }
        sides = ((-0.036, 0.036), (-0.03, 0.03), (0.0, 0.054))
        mesh = box_mesh(*(uniform_planes(*side, n) for side, n in zip(sides, _NODES, strict=True)))
        x, y, z = mesh.nodes.T
        nodes = mesh.nodes.copy()
        nodes[:, 2] += _PRESS * np.exp(-(x**2 + y**2) / 0.02**2) * (1.0 - z / 0.054)
        scanners = {}
        for name, acoustics in kinds.items():
            scanners[name] = BMode(volume, probe, Imaging(), acoustics)
            scanners[name].prepare(probe, Imaging(), acoustics)
            scanners[name].carry(mesh.nodes, mesh.tetrahedra)
        spent: dict[str, list[float]] = {name: [] for name in scanners}
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            for number in range(_QUICK_IMAGES if quick else _IMAGES):
                pose = Pose(np.array([2e-4 * (number % 7), 0.0, _PRESS]))
                for name, scanner in scanners.items():
                    begin = time.thread_time()
                    scanner.image(pose, nodes)
                    spent[name].append(1e3 * (time.thread_time() - begin))
        finally:
            cv2.setNumThreads(threads)
        medians = {name: float(np.median(times[5:])) for name, times in spent.items()}
        return [
            Point(f"{self.name}_{name}", "linear", measured=ms, unit="ms", ms_median=ms)
            for name, ms in medians.items()
        ]

    def targets(self, points: Sequence[Point]) -> list[Target]:
        ms = {p.artefact.removeprefix(f"{self.name}_"): p.ms_median for p in points}
        what = "ms an image of 512 × 512 with all acoustics, 34,875 tetrahedra, one core"
        return [
            Target.at_most(what, _LIMIT, ms["all"], form=".2f"),
            Target.at_most(
                "as many times what the slice alone takes", 1.67, ms["all"] / ms["slice"]
            ),
        ]

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        del folder
        rows = [
            (
                p.artefact.removeprefix(f"{self.name}_").replace("_", " "),
                f"{p.ms_median:.2f}",
                f"{p.ms_median / points[0].ms_median:.2f}",
            )
            for p in points
        ]
        return [markdown_table(("with", "ms", "times the slice"), rows)]
