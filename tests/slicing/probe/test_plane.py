"""Probe geometry: where the pixels are."""

import numpy as np
import pytest

from us_sim.errors import ProbeError
from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import LinearProbe


def test_pixels_fill_the_aperture_from_the_face_down():
    pixels = LinearProbe(aperture=0.04, depth=0.06, columns=4, rows=3).plane(Pose()).pixels()
    np.testing.assert_allclose(pixels[0, :, 0], [-0.015, -0.005, 0.005, 0.015])
    np.testing.assert_allclose(pixels[:, 0, 2], [0.01, 0.03, 0.05])
    assert not pixels[..., 1].any()


def test_the_plane_moves_with_the_pose():
    quarter_turn_about_z = Pose([1.0, 2.0, 3.0], [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    probe = LinearProbe(aperture=0.04, depth=0.06, columns=4, rows=3)
    expected = quarter_turn_about_z.apply(probe.plane(Pose()).pixels().reshape(-1, 3))
    np.testing.assert_allclose(
        probe.plane(quarter_turn_about_z).pixels().reshape(-1, 3), expected, atol=1e-15
    )
    np.testing.assert_allclose(expected[0], [1.0, 1.985, 3.01])


def test_to_pixel_undoes_pixels():
    pose = Pose([0.1, -0.2, 0.3], [0.1, 0.2, 0.3, 0.9])
    plane = LinearProbe(aperture=0.05, depth=0.03, columns=7, rows=5).plane(pose)
    found = plane.pixels() @ plane.to_pixel[:, :3].T + plane.to_pixel[:, 3]
    column, row = np.meshgrid(np.arange(7), np.arange(5))
    np.testing.assert_allclose(found, np.stack([column, row, 0 * row], -1), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"aperture": 0.002}, "probe.aperture: 0.002 m is outside 0.003 to 0.2 m"),
        ({"aperture": float("nan")}, "probe.aperture: nan is not finite"),
        ({"depth": 0.5}, "probe.depth: 0.5 m is outside 0.005 to 0.4 m"),
        ({"depth": "deep"}, "probe.depth: 'deep' is not a length"),
        ({"columns": 0}, "0 columns"),
        ({"rows": 4097}, "4097 rows"),
        ({"rows": 2.5}, "2.5 rows"),
    ],
)
def test_a_probe_that_cannot_be_is_refused(change, words):
    good = {"aperture": 0.04, "depth": 0.06, "columns": 4, "rows": 3}
    with pytest.raises(ProbeError, match=words):
        LinearProbe(**{**good, **change})


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
    with pytest.raises(ProbeError, match="two runs of columns, 0 to 5, of each of the 4 rows"):
        SlicePlane(**steps, columns=5, rows=4, spans=spans)
    runs = np.zeros((4, 2, 2), dtype=np.int64)
    runs[:, 0] = [1, 4]
    shown = SlicePlane(**steps, columns=5, rows=4, spans=runs).is_shown()
    np.testing.assert_array_equal(shown, np.tile([False, True, True, True, False], (4, 1)))
