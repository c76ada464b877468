"""Pixels, beams, outlines and places of each kind of transducer, in millimetres."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from us_sim.errors import ProbeError
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.probe.beams import (
    compute_beam_angles,
    compute_beam_coordinates,
    convert_to_pixels,
    require_depth,
)
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

DEGREE = math.pi / 180

pixel_count = st.integers(1, 90)
numbers = {
    "depth": st.floats(0.01, 0.11),
    "columns": pixel_count,
    "rows": pixel_count,
    "lines": st.integers(1, 40),
    "samples": st.integers(1, 40),
}


def sector(radius, room, **others):
    """A sector whose face is as large as its virtual apex needs, and some more."""
    used = 2 * radius * math.tan(others["opening_angle"] / 2)
    assume(used < 0.05)
    return SectorProbe(aperture=max(used, 3e-3) + room * (0.05 - used), radius=radius, **others)


linear = st.builds(LinearProbe, aperture=st.floats(0.01, 0.15), **numbers)
convex = st.builds(
    ConvexProbe,
    radius=st.floats(5e-3, 0.1),
    opening_angle=st.floats(5 * DEGREE, math.pi),
    **numbers,
)
phased = st.builds(
    sector,
    radius=st.one_of(st.just(0.0), st.floats(0.0, 0.03)),
    room=st.floats(0.0, 0.5),
    opening_angle=st.floats(5 * DEGREE, 140 * DEGREE),
    **numbers,
)
probe = st.one_of(linear, convex, phased)


def pixel_positions(probe):
    """(rows, columns) m: x and z of the pixel centres, by the map that is published."""
    column, row = np.meshgrid(np.arange(probe.columns), np.arange(probe.rows))
    pixels = np.stack([column, row, 0 * row, 0 * row + 1], -1) @ probe.image_to_probe.T
    assert not pixels[..., 1].any()
    return pixels[..., 0], pixels[..., 2]


def beam_through(probe, x, z):
    """Angle of the beam through points, and the way along it from the face, written down anew."""
    if isinstance(probe, LinearProbe):
        return x, z
    apex = probe.radius
    angle = np.arctan2(x, z + apex)
    start = apex if isinstance(probe, ConvexProbe) else apex / np.cos(angle)
    return angle, np.hypot(x, z + apex) - start


def mask(probe, slack):
    """Which pixel centres lie in the outline, made wider by a share ``slack`` of it."""
    x, z = pixel_positions(probe)
    across, way = beam_through(probe, x, z)
    widest = probe.aperture if isinstance(probe, LinearProbe) else probe.opening_angle
    return (
        (np.abs(across) <= widest * (0.5 + slack))
        & (way >= -slack * probe.depth)
        & (way <= (1 + slack) * probe.depth)
    )


@settings(deadline=None, max_examples=150)
@given(probe)
def test_shown_pixels_are_those_in_the_outline(probe):
    shown = probe.make_plane(Pose()).make_shown_mask()
    assert (mask(probe, -1e-7) <= shown).all()
    assert (shown <= mask(probe, 1e-7)).all()
    np.testing.assert_array_equal(np.isfinite(probe.pixel_beams), [shown, shown])


@pytest.mark.parametrize(
    ("probe", "area", "perimeter"),
    [
        (LinearProbe(0.04, 0.05, 80, 90), 0.04 * 0.05, 0.0),
        # A ring's sixth between radii 50 and 200 mm.
        (
            ConvexProbe(0.05, 60 * DEGREE, 0.15, 700, 500),
            math.pi / 6 * (0.2**2 - 0.05**2),
            math.pi / 3 * 0.25 + 0.3,
        ),
        # A quarter disc.
        (
            SectorProbe(0.02, 90 * DEGREE, 0.16, 500, 400),
            math.pi / 4 * 0.16**2,
            math.pi / 2 * 0.16 + 0.32,
        ),
        # From an apex r behind the face a beam of length d sweeps d**2 / 2 + d r / cos(angle).
        (
            SectorProbe(0.02, 90 * DEGREE, 0.16, 500, 400, radius=0.01),
            math.pi / 4 * 0.16**2 + 2 * 0.01 * 0.16 * math.asinh(1.0),
            math.pi / 2 * 0.175 + 0.34,
        ),
    ],
)
def test_the_shown_area_is_the_analytic_one_within_a_pixel_all_around(probe, area, perimeter):
    pixel = probe.pixel_spacing
    found = probe.make_plane(Pose()).make_shown_mask().sum() * pixel[0] * pixel[1]
    assert abs(found - area) <= 1e-12 + 0.5 * perimeter * pixel.max()


@settings(deadline=None, max_examples=60)
@given(probe)
def test_each_pixel_lies_where_its_beam_says(probe):
    line, way = (beams.astype(float) for beams in probe.pixel_beams)
    shown = np.isfinite(line)
    x, z = (positions[shown] for positions in pixel_positions(probe))
    across, expected = beam_through(probe, x, z)
    widest = probe.aperture if isinstance(probe, LinearProbe) else probe.opening_angle
    part = (line[shown] + 0.5) / probe.lines
    np.testing.assert_allclose((part - 0.5) * widest, across, atol=1e-6 * widest)  # of float32
    np.testing.assert_allclose(way[shown], expected, atol=1e-6 * probe.depth)


@settings(deadline=None, max_examples=60)
@given(probe)
def test_each_sample_of_a_beam_lies_at_its_pixel(probe):
    column, row = probe.beam_pixels.astype(float)
    assert column.shape == (probe.samples, probe.lines)
    image = np.stack([column, row, 0 * row, 0 * row + 1], -1)
    way = (np.arange(probe.samples) + 0.5) * probe.depth / probe.samples
    expected = probe.beam_starts + way[:, None, None] * probe.beam_directions
    found = (image @ probe.image_to_probe.T)[..., [0, 2]]
    np.testing.assert_allclose(found, expected, atol=3e-6 * (probe.depth + probe.width))
    assert column.min() >= -0.5 - 1e-3
    assert column.max() <= probe.columns - 0.5 + 1e-3


@settings(deadline=None, max_examples=30)
@given(probe, st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(0.1, 1)] * 4))
def test_the_plane_is_the_image_to_probe_map_moved_by_the_pose(probe, position, orientation):
    pose = Pose(position, orientation)
    x, z = pixel_positions(probe)
    expected = pose.transform_points(np.stack([x, 0 * x, z], -1).reshape(-1, 3))
    np.testing.assert_allclose(
        probe.make_plane(pose).compute_pixel_positions().reshape(-1, 3), expected, atol=1e-12
    )
    scale = probe.image_to_probe[:3, :3] / np.append(probe.pixel_spacing, 1.0)
    np.testing.assert_allclose(scale.T @ scale, np.eye(3), atol=1e-12)
    assert np.linalg.det(scale) == pytest.approx(1.0)


# What one sees of wires stretched across the image plane, at known places in millimetres.

# Of the beams: across is the angle in degrees (mm for the linear array), way is in mm.
WIRES = {
    "linear": (
        LinearProbe(0.04, 0.06, columns=150, rows=180, lines=80),
        [(-15, 8), (-4, 21), (0, 30), (12, 42), (-9, 52)],
    ),
    "convex": (
        ConvexProbe(0.03, 60 * DEGREE, 0.06, lines=96).with_square_pixels(200),
        [(-24, 6), (0, 12), (12, 31), (20, 50), (-15, 44)],
    ),
    "convex with other pixels": (
        ConvexProbe(0.015, 110 * DEGREE, 0.045, columns=300, rows=140, lines=64),
        [(-48, 6), (0, 12), (32, 24), (45, 30), (-30, 33)],
    ),
    "sector": (
        SectorProbe(0.015, 80 * DEGREE, 0.06, lines=128).with_square_pixels(220),
        [(-30, 20), (0, 9), (12, 31), (33, 45), (-15, 53)],
    ),
    "sector from behind the face": (
        SectorProbe(
            0.02, 80 * DEGREE, 0.055, columns=260, rows=200, radius=0.01, lines=100, samples=64
        ),
        [(-30, 20), (0, 6), (33, 8), (28, 40), (-15, 47)],
    ),
}


def wire_at(probe, across, way):
    """x and z (mm) of a wire, from the geometry as a textbook has it."""
    if isinstance(probe, LinearProbe):
        return across, way
    sine, cosine, radius = math.sin(across * DEGREE), math.cos(across * DEGREE), 1e3 * probe.radius
    if isinstance(probe, ConvexProbe):
        return (radius + way) * sine, (radius + way) * cosine - radius
    return radius * sine / cosine + way * sine, way * cosine


def wire_phantom(pose, wires):
    """Wires along y of the probe at ``pose``: 1.2 mm thick (standard deviation), 0.6 mm voxels."""
    to_patient = np.diag([0.6e-3, 0.8e-3, 0.6e-3, 1.0])
    to_patient[:3, 3] = [-0.054, -0.008, -0.012]
    shape = (181, 21, 141)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    at = (
        pose.inverse()
        .transform_points(index.reshape(-1, 3) @ to_patient[:3, :3].T + to_patient[:3, 3])
        .reshape(*shape, 3)
    )
    squared = np.min(
        [(1e3 * at[..., 0] - x) ** 2 + (1e3 * at[..., 2] - z) ** 2 for x, z in wires], axis=0
    )
    return Volume(np.round(250 * np.exp(-squared / (2 * 1.2**2))).astype(np.uint8), to_patient)


@pytest.mark.parametrize("name", WIRES)
def test_wires_appear_at_their_millimetre(name):
    probe, places = WIRES[name]
    wires = [wire_at(probe, *place) for place in places]
    pose = Pose([2e-3, -1e-3, 1.5e-3], [0.02, 0.06, -0.03, 1.0])
    volume = wire_phantom(pose, wires)
    mesh = box_mesh(*(uniform_planes(-0.06, 0.06, 3) for _ in range(2)), uniform_planes(0, 0.08, 3))
    slicer = create_slicer("scan_conversion", volume, mesh.nodes, mesh.tetrahedra)
    image = slicer.cut_image(mesh.nodes, probe.make_plane(pose)).astype(float)
    assert not image[~probe.make_plane(pose).make_shown_mask()].any()
    x, z = 1e3 * np.array(pixel_positions(probe))
    line, way = probe.pixel_beams.astype(float)
    for (across, depth), (wire_x, wire_z) in zip(places, wires, strict=True):
        weight = image * (np.hypot(x - wire_x, z - wire_z) < 4.0)
        column = (weight.sum(axis=0) @ np.arange(probe.columns)) / weight.sum()
        row = (weight.sum(axis=1) @ np.arange(probe.rows)) / weight.sum()
        found = 1e3 * (probe.image_to_probe @ [column, row, 0, 1])[[0, 2]]
        off = (found - [wire_x, wire_z]) / (1e3 * probe.pixel_spacing)
        assert np.abs(off).max() < 0.5
        # By the beams: at the pixel nearest to the wire, and so within a pixel's diagonal.
        nearest = round(row), round(column)
        diagonal = 1e3 * math.hypot(*probe.pixel_spacing)
        assert abs(1e3 * way[nearest] - depth) < diagonal
        part = (line[nearest] + 0.5) / probe.lines - 0.5
        if isinstance(probe, LinearProbe):
            assert abs(1e3 * probe.aperture * part - across) < diagonal
        else:
            angle = probe.opening_angle * part
            from_apex = 1e3 * probe.radius + depth
            assert abs(angle - across * DEGREE) * from_apex < diagonal


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ConvexProbe(0.05, 1.0, 0.1, 0, 5), "probe.image: the image has 0 columns"),
        (lambda: LinearProbe(0.04, 0.06, 4, 4097), "4097 rows"),
        (lambda: LinearProbe(0.04, 0.06, 4, 2.5), "2.5 rows"),
        (lambda: LinearProbe(0.1, 0.05).with_square_pixels(4096), "8192 columns"),
        (
            lambda: SectorProbe(0.02, 90 * DEGREE, 0.1, radius=0.02),
            r"probe.aperture: 20 mm is less than the 40 mm .* over 90 degrees .* 20 mm behind it",
        ),
    ],
)
def test_a_geometry_that_cannot_be_is_refused(make, words):
    with pytest.raises(ProbeError, match=words):
        make()


@pytest.mark.parametrize(
    ("frequencies", "deepest"), [((4e6, 16e6), 0.115), ((2e6, 5e6), 0.29), ((1e6, 2e6), 0.4)]
)
def test_an_image_ends_where_a_probe_of_its_frequencies_hears_no_echoes(frequencies, deepest):
    made = LinearProbe(aperture=0.04, depth=deepest, frequencies=frequencies)
    assert made.get_upper_limit("depth") == made.greatest_depth == deepest
    assert made.get_upper_limit("focus") == 0.4
    if deepest < 0.4:
        words = f"probe.depth: 400 mm is more than the {1e3 * deepest:g} mm .*probe.frequencies"
        with pytest.raises(ProbeError, match=words):
            dataclasses.replace(made, depth=0.4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"origin": [0, 0]}, "origin is not three finite"),
        ({"row_step": [0, 0, np.inf]}, "row_step is not three finite"),
        ({"row_step": [2e-3, 0, 0]}, "do not span a plane"),
        ({"column_step": [0, 0, 0]}, "do not span a plane"),
    ],
)
def test_a_plane_that_cannot_be_is_refused(change, words):
    good = {"origin": [0, 0, 0], "column_step": [1e-3, 0, 0], "row_step": [0, 0, 1e-3]}
    with pytest.raises(ProbeError, match=words):
        SlicePlane(**{**good, **change}, columns=3, rows=3)


@pytest.mark.parametrize(
    "spans",
    [np.zeros((3, 2, 2)), np.full((4, 2, 2), 6), np.full((4, 2, 2), -1), np.zeros((0, 2, 2))],
)
def test_spans_beyond_the_image_are_refused(spans):
    steps = {"origin": np.zeros(3), "column_step": np.eye(3)[0], "row_step": np.eye(3)[2]}
    with pytest.raises(ProbeError, match=r"0 to 5, .* 4 rows"):
        SlicePlane(**steps, columns=5, rows=4, spans=spans)
    runs = np.zeros((4, 2, 2), dtype=np.int64)
    runs[:, 0] = [1, 4]
    shown = SlicePlane(**steps, columns=5, rows=4, spans=runs).make_shown_mask()
    np.testing.assert_array_equal(shown, np.tile([False, True, True, True, False], (4, 1)))


STEERED = [
    LinearProbe(aperture=0.04, depth=0.05, columns=70, rows=80),
    LinearProbe(aperture=0.04, depth=0.05, columns=70, rows=80, lines=1),
    ConvexProbe(radius=0.05, opening_angle=1.1, depth=0.1, columns=90, rows=80),
    SectorProbe(aperture=0.02, opening_angle=1.4, depth=0.1, columns=90, rows=80),
    SectorProbe(aperture=0.03, opening_angle=1.0, depth=0.1, columns=90, rows=80, radius=0.02),
]


@pytest.mark.parametrize("probe", STEERED)
def test_every_pixel_lies_where_its_own_beam_and_depth_lead(probe):
    if probe.lines == 1:
        return  # between the lines of one line there is nothing
    fraction, depth = compute_beam_coordinates(probe)
    row, column = np.nonzero(~np.isnan(depth))
    places = convert_to_pixels(probe, fraction[row, column], depth[row, column])
    # Where beams leave one point, the start between two lines is between their starts.
    assert np.abs(places - np.column_stack([column, row])).max() < 0.02


@given(fraction=st.floats(-0.5, 0.5), depth=st.floats(1e-3, 0.04), angle=st.floats(-0.5, 0.5))
def test_a_steered_beam_leaves_its_upright_one_by_the_angle(fraction, depth, angle):
    probe = STEERED[0]
    upright, steered = (
        convert_to_pixels(probe, np.array([fraction]), np.array([depth]), turn)[0]
        for turn in (0.0, angle)
    )
    moved = (steered - upright) * probe.pixel_spacing
    assert moved == pytest.approx([depth * np.sin(angle), depth * (np.cos(angle) - 1)], abs=1e-9)
    assert compute_beam_angles(probe, np.array([fraction]), angle)[0] == pytest.approx(angle)


def test_a_depth_outside_the_image_is_refused_and_none_is_its_middle():
    assert require_depth(STEERED[0], "gate.depth", None, "the gate") == 0.025
    with pytest.raises(ProbeError, match=r"gate.depth: .* 50 mm"):
        require_depth(STEERED[0], "gate.depth", 0.05, "the gate")
