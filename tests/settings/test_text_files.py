"""Files without an end are refused by whatever reads a text, and pipes are read.

YAML that is too large or too deep, or has a key twice, is refused.
"""

import os
import threading

import pytest

from us_sim.errors import CalibrationError, SceneError, TrackingError
from us_sim.scene.reading import read_document
from us_sim.settings.text_files import LARGEST_YAML, YamlError, load_yaml, read_text
from us_sim.tracking.calibration.transform_file import read_transform
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
        (read_transform, CalibrationError),
        (read_rigid_body, TrackingError),
        (lambda path: read_document(path, lambda _: path), SceneError),
    ],
)
@pytest.mark.parametrize("name", ["zero", "zero.xml"])
def test_what_has_no_end_is_refused(tmp_path, read, error, name):
    path = tmp_path / name
    path.symlink_to("/dev/zero")
    with pytest.raises(error, match="64 MiB"):
        read(path)


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("[" * 100_000 + "]" * 100_000, "YAML"),
        ("a: 'x" + "x" * LARGEST_YAML + "'", str(LARGEST_YAML)),
        ("a: 1\nb: 2\na: 3", "line 3: .*`a`.*line 1"),
        ("x: &x {a: 1}\ny: {<<: *x, <<: *x}", "line 2: .*`<<`"),
        *((text, "YAML") for text in ("!!timestamp foo", "!!int ''", "? [a]\n: b")),
    ],
)
def test_what_nobody_writes_by_hand_is_refused(text, fact):
    with pytest.raises(YamlError, match=fact):
        load_yaml(text)


def test_what_people_write_is_read():
    text = "base: &base {depth: 4 cm, lines: 128}\nprobe: {<<: *base, depth: 6 cm}\n"
    assert load_yaml(text)["probe"] == {"depth": "6 cm", "lines": 128}
    assert load_yaml("a: [1, 2.5, ~, true]") == {"a": [1, 2.5, None, True]}
    assert load_yaml("") is None
    assert load_yaml("[" * 60 + "]" * 60)
