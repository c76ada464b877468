"""Places along beams are the pixels through which these beams go."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.errors import ProbeError
from us_sim.slicing.probe.beams import (
    beam_angles,
    fractions_and_depths,
    pixels_of,
    require_depth,
)
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe

PROBES = [
    LinearProbe(aperture=0.04, depth=0.05, columns=70, rows=80),
    LinearProbe(aperture=0.04, depth=0.05, columns=70, rows=80, lines=1),
    ConvexProbe(radius=0.05, opening_angle=1.1, depth=0.1, columns=90, rows=80),
    SectorProbe(aperture=0.02, opening_angle=1.4, depth=0.1, columns=90, rows=80),
    SectorProbe(aperture=0.03, opening_angle=1.0, depth=0.1, columns=90, rows=80, radius=0.02),
]


@pytest.mark.parametrize("probe", PROBES)
def test_every_pixel_lies_where_its_own_beam_and_depth_lead(probe):
    if probe.lines == 1:
        return  # between the lines of one line there is nothing
    fraction, depth = fractions_and_depths(probe)
    row, column = np.nonzero(~np.isnan(depth))
    places = pixels_of(probe, fraction[row, column], depth[row, column])
    # Where beams leave one point, the start between two lines is between their starts.
    assert np.abs(places - np.column_stack([column, row])).max() < 0.02


@given(fraction=st.floats(-0.5, 0.5), depth=st.floats(1e-3, 0.04), angle=st.floats(-0.5, 0.5))
def test_a_steered_beam_leaves_its_upright_one_by_the_angle(fraction, depth, angle):
    probe = PROBES[0]
    upright, steered = (
        pixels_of(probe, np.array([fraction]), np.array([depth]), turn)[0] for turn in (0.0, angle)
    )
    moved = (steered - upright) * probe.pixel_spacing
    assert moved == pytest.approx([depth * np.sin(angle), depth * (np.cos(angle) - 1)], abs=1e-9)
    assert beam_angles(probe, np.array([fraction]), angle)[0] == pytest.approx(angle)


def test_one_line_is_everywhere_the_same():
    assert (
        pixels_of(PROBES[1], np.array([-0.4, 0.4]), np.array([0.02, 0.02])).std(axis=0).max() == 0
    )


def test_a_depth_outside_the_image_is_refused_and_none_is_its_middle():
    assert require_depth(PROBES[0], "gate.depth", None, "the gate") == 0.025
    with pytest.raises(ProbeError, match=r"gate.depth: the gate at 50 mm lies outside the image"):
        require_depth(PROBES[0], "gate.depth", 0.05, "the gate")
