"""Files without an end are refused by whatever reads a text, and pipes are read.

YAML of unknown origin: what is larger, deeper or more than one thing is refused at once.
"""

import os
import threading

import pytest

from us_sim.errors import CalibrationError, SceneError, TrackingError
from us_sim.scene.reading import read_document
from us_sim.settings.text_files import LARGEST_YAML, MOST_NODES, YamlError, load_yaml, read_text
from us_sim.tracking.calibration.landmarks import read_landmarks, read_wires
from us_sim.tracking.calibration.transform_file import read_transform
from us_sim.tracking.camera.model import read_camera_info
from us_sim.tracking.camera.rigid_body import read_rigid_body


def test_a_pipe_is_read(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=lambda: pipe.write_text("Grüße\n", encoding="utf-8"))
    writer.start()
    assert read_text(pipe) == "Grüße\n"
    writer.join()


@pytest.mark.parametrize(
    ("read", "error"),
    [
        (read_landmarks, CalibrationError),
        (read_wires, CalibrationError),
        (read_transform, CalibrationError),
        (read_camera_info, TrackingError),
        (read_rigid_body, TrackingError),
        (lambda path: read_document(path, lambda _: path), SceneError),
    ],
)
@pytest.mark.parametrize("name", ["zero", "zero.xml"])
def test_what_has_no_end_is_refused(tmp_path, read, error, name):
    path = tmp_path / name
    path.symlink_to("/dev/zero")
    with pytest.raises(error, match="more than 64 MiB, and no text is so long"):
        read(path)


def bomb():
    """Ten times ten times ... one value, in ten lines."""
    lines = ["a0: &a0 [1]"]
    lines += [f"a{k}: &a{k} " + "[" + ", ".join([f"*a{k - 1}"] * 10) + "]" for k in range(1, 10)]
    return "\n".join(lines)


def merge_bomb():
    """The same by the key `<<`."""
    lines = ["a0: &a0 {k: 1}"]
    lines += [f"a{k}: &a{k} {{<<: [" + ", ".join([f"*a{k - 1}"] * 10) + "]}" for k in range(1, 10)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (bomb(), "line 6: holds more than 100000 values"),
        (merge_bomb(), "line 6: holds more than 100000 values"),
        ("[" * 1000 + "]" * 1000, "line 1: has more than 64 lists and mappings within each"),
        ("- " * 100_000, "line 1: has more than 64 lists and mappings within each"),
        ("a: &a [1, *a]", "`*a` is within itself"),
        ("a: &a {b: [*a]}", "`*a` is within itself"),
        ("a: 'x" + "x" * LARGEST_YAML + "'", f"of which {LARGEST_YAML} are read at most"),
        ("- 1\n" * (MOST_NODES + 1), "holds more than 100000 values up to here"),
        ("1:" * 100_000 + "1", "a number of 200001 characters"),
        ("9" * 100_000, "a number of 100000 characters"),
        ("a: 1\nb: 2\na: 3", "line 3: key `a` is there twice, first in line 1: keep one"),
        ("x: &x {a: 1}\ny: {<<: *x, <<: *x}", "line 2: key `<<` is there twice"),
        ("a: {b: [{c: 1, c: 2}]}", "line 1: key `c` is there twice"),
        ("!!timestamp foo", "is not YAML: "),
        ("!!int ''", "is not YAML: "),
        ("? [a]\n: b", "is not YAML: "),
    ],
)
def test_what_nobody_writes_by_hand_is_refused(text, sentence):
    with pytest.raises(YamlError) as refused:
        load_yaml(text)
    assert sentence in str(refused.value)


def test_what_people_write_is_read():
    text = "base: &base {depth: 4 cm, lines: 128}\nprobe: {<<: *base, depth: 6 cm}\n"
    assert load_yaml(text)["probe"] == {"depth": "6 cm", "lines": 128}
    assert load_yaml("a: [1, 2.5, ~, true]") == {"a": [1, 2.5, None, True]}
    assert load_yaml("") is None
    assert load_yaml("[" * 60 + "]" * 60)
