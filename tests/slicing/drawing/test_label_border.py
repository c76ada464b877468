"""Outlines of labels against the curves that their voxels were made of."""

from functools import partial

import cv2
import numpy as np
import pytest

from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.drawing.label_outlines import label_outlines, onto_border
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

VOXEL = 0.3e-3  # m
PROBE = LinearProbe(aperture=0.03, depth=0.024, columns=400, rows=320)  # four pixels a voxel
PIXEL = 0.075  # mm
MIDDLE = np.array([15.2, 11.3])  # mm, of the vessel
MESH = box_mesh(
    uniform_planes(-0.003, 0.033, 7), uniform_planes(0.0, 0.003, 2), uniform_planes(0.0, 0.024, 7)
)


@pytest.fixture(scope="module")
def volume():
    """A vessel of 3.1 mm radius along y."""
    x, _, z = np.indices((120, 10, 100)) * 1e3 * VOXEL
    inside = (x - MIDDLE[0]) ** 2 + (z - MIDDLE[1]) ** 2 < 3.1**2
    labels = inside.astype(np.uint8)
    return Volume(labels, np.diag([VOXEL, VOXEL, VOXEL, 1.0]), labels, {1: "vein"})


@pytest.mark.parametrize("flat", [1.0, 0.4, 0.12])
def test_an_outline_has_no_steps_and_its_area_whatever_the_press(volume, flat):
    scanner = BMode(volume, PROBE)
    scanner.carry(MESH.nodes, MESH.tetrahedra)
    pressed = MESH.nodes * [1.0, 1.0, flat]
    frame = scanner.frame(Pose([0.015, 0.0014, 0.0]), pressed)
    settle = partial(onto_border, frame)
    (plain,) = label_outlines(frame.labels, 1, smoothing=5.0)
    (outline,) = label_outlines(frame.labels, 1, smoothing=5.0, settle=settle)

    def off(points):
        """mm, root mean square from the ellipse that the circle has become."""
        x, z = (PIXEL * (points + 0.5)).T
        around = np.linspace(0.0, 2 * np.pi, 4000)
        a, b = MIDDLE[0] + 3.1 * np.cos(around), flat * (MIDDLE[1] + 3.1 * np.sin(around))
        return np.sqrt(((x[:, None] - a) ** 2 + (z[:, None] - b) ** 2).min(axis=1).mean())

    def turned(points):
        """Of its sides, in turns: 1 without steps and corners inwards."""
        across, down = np.diff(points, axis=0, append=points[:1]).T
        directions = np.exp(1j * np.arctan2(down, across))
        return np.abs(np.angle(directions / np.roll(directions, 1))).sum() / (2 * np.pi)

    assert off(outline) < 0.7 * off(plain)
    assert off(outline) < 0.12 * 1e3 * VOXEL
    assert turned(outline) < 1.1
    area = PIXEL**2 * cv2.contourArea(outline.astype(np.float32))
    assert area == pytest.approx(np.pi * 3.1**2 * flat, rel=0.02)


def test_what_the_image_cuts_off_ends_at_its_side(volume):
    frame = BMode(volume, PROBE).frame(Pose([0.0152, 0.0014, 0.0113]))
    settle = partial(onto_border, frame)
    (outline,) = label_outlines(frame.labels, 1, smoothing=2.0, settle=settle)
    assert -0.6 < outline[:, 1].min() < 0.6
    assert np.isfinite(outline).all()
