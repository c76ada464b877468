"""Planes of a box where they count: laws on any wish, and what a vessel needs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.tissue.mesh.box_planes import (
    DesiredSpacing,
    fit_planes,
    spacing_by_labels,
    spacing_under_probe,
)


def wish(spacing, length):
    return DesiredSpacing(np.linspace(0.0, length, len(spacing) + 1), np.array(spacing))


AXIS = st.builds(
    wish, st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=30), st.floats(0.01, 0.5)
)


@settings(max_examples=40, deadline=None)
@given(axes=st.tuples(AXIS, AXIS, AXIS), nodes=st.integers(27, 20_000))
def test_planes_ascend_from_end_to_end_and_are_no_more_than_asked(axes, nodes):
    planes = fit_planes(axes, nodes)
    assert np.prod([len(p) for p in planes]) <= nodes
    for axis, found in zip(axes, planes, strict=True):
        assert found[0] == axis.edges[0]
        assert found[-1] == axis.edges[-1]
        assert (np.diff(found) > 0).all()


def test_cells_are_as_long_as_wished_where_they_are_near_to_what_is_thin():
    edges = np.linspace(0.0, 0.1, 1001)
    thin = DesiredSpacing(edges, np.where((edges[1:] > 0.05) & (edges[1:] <= 0.06), 1e-3, 1.0))
    flat = wish([1.0], 0.1)
    planes, *_ = fit_planes([thin, flat, flat], 3 * 3 * 60)
    steps, middles = np.diff(planes), (planes[1:] + planes[:-1]) / 2
    inside = (middles > 0.051) & (middles < 0.059)
    # Every cell has the same share of the wish, so those of one wish are of one length, and the
    # wish grows by 0.35 of the distance from there.
    np.testing.assert_allclose(steps[inside], steps[inside][0], rtol=0.05)
    far = steps[np.abs(middles - 0.03).argmin()] / steps[inside][0]
    assert far == pytest.approx((1e-3 + 0.35 * 0.02) / 1e-3, rel=0.1)


@pytest.mark.parametrize("radius", [3e-3, 6e-3])
def test_a_round_vessel_asks_for_a_third_of_its_thickness_at_its_middle(radius):
    step = 5e-4
    x, z = np.meshgrid(*[np.arange(80) * step] * 2, indexing="ij")
    section = np.hypot(x - 0.02, z - 0.02) < radius
    labels = np.repeat(section[:, None, :], 40, axis=1).astype(np.uint8)
    box = np.array([[0.0, 0.0, 0.0], [0.0395, 0.0195, 0.0395]])
    index = np.diag([1 / step] * 3 + [1.0])
    wanted = spacing_by_labels(labels, index, box, step)
    for axis in (wanted[0], wanted[2]):
        middle = axis.spacing[len(axis.spacing) // 2]
        # The median, over a diameter, of chords at right angles to it: it is the chord itself.
        assert middle == pytest.approx(2 * radius / 3, abs=step)
        assert axis.spacing[0] == pytest.approx(0.0395 / 3)
    assert (wanted[1].spacing >= 0.0195 / 3 - 1e-9).all()  # along the vessel nothing is thin
    assert (spacing_by_labels(labels, index, box, step, counted=[])[0].spacing > 0.01).all()


def test_under_the_probe_cells_are_no_longer_than_half_its_half_width():
    flat = wish([1.0] * 100, 0.1)
    x = DesiredSpacing(flat.edges - 0.05, flat.spacing)
    found = spacing_under_probe([x, x, flat], 0.02, 0.008)
    centre = (x.edges[1:] + x.edges[:-1]) / 2
    np.testing.assert_allclose(found[0].spacing[np.abs(centre) < 0.02], 4e-3)
    np.testing.assert_allclose(found[1].spacing[np.abs(centre) < 0.008], 4e-3)
    assert found[2].spacing[0] < 5e-3 < found[2].spacing[-1]
