"""A transform's file gives back what was written, and says what is wrong with it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.transform_file import (
    read_transform,
    write_transform,
)

HALF_TURN = "orientation: [1, 0, 0, 0]\n"
numbers = st.floats(-10.0, 10.0)


@settings(max_examples=30, deadline=None)
@given(
    position=st.tuples(numbers, numbers, numbers),
    orientation=st.tuples(numbers, numbers, numbers, numbers).filter(
        lambda q: np.linalg.norm(q) > 1e-3
    ),
)
def test_what_is_written_is_read_to_the_last_bit(tmp_path_factory, position, orientation):
    file = tmp_path_factory.mktemp("files") / "t.yaml"
    pose = Pose(position, orientation)
    write_transform(file, pose, from_frame="a", to_frame="b", method="by hand")
    read = read_transform(file)
    np.testing.assert_array_equal(read.position, pose.position)
    np.testing.assert_allclose(read.orientation, pose.orientation, rtol=0, atol=3e-16)


def test_a_file_is_never_overwritten(tmp_path):
    file = tmp_path / "t.yaml"
    file.write_text("mine")
    with pytest.raises(CalibrationError, match="exists already"):
        write_transform(file, Pose(), from_frame="a", to_frame="b", method="m")
    assert file.read_text() == "mine"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "position"),
        ("position: [0, 0, 0]\n", "orientation"),
        ("position: [0, 0, .nan]\n" + HALF_TURN, "finite"),
        ("position: [0, 0, 0]\norientation: [0, 0, 0, 0]\n", "zero"),
        ("position: [0, 0\n", "YAML"),
        (None, "cannot be read"),
    ],
)
def test_a_file_that_is_no_transform_is_refused(tmp_path, text, word):
    file = tmp_path / "given.yaml"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=f"given.yaml: .*{word}"):
        read_transform(file)
