"""The outline of an image is where its beams begin and end."""

import math

import numpy as np
import pytest

from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe, image_outline

PROBES = [
    LinearProbe(aperture=0.04, depth=0.05),
    ConvexProbe(radius=0.06, opening_angle=math.radians(60), depth=0.14),
    SectorProbe(aperture=0.02, opening_angle=math.radians(90), depth=0.16),
]


@pytest.mark.parametrize("probe", PROBES, ids=lambda p: type(p).__name__)
def test_the_outlines_box_is_the_image(probe):
    outline = image_outline(probe)
    low, high = outline.min(axis=0), outline.max(axis=0)
    assert high[0] - low[0] == pytest.approx(probe.width, rel=1e-6)
    assert high[2] - low[2] == pytest.approx(probe.height, rel=2e-3)
    assert not outline[:, 1].any()


@pytest.mark.parametrize("probe", PROBES, ids=lambda p: type(p).__name__)
def test_every_beam_is_as_long_as_the_image_is_deep(probe):
    outline = image_outline(probe)
    lengths = np.linalg.norm(
        outline[: len(outline) // 2] - outline[len(outline) // 2 :][::-1], axis=1
    )
    assert lengths == pytest.approx(probe.depth)
