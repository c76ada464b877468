"""Parts of a recording as files, read by programs that are not ours."""

import csv

import cv2
import numpy as np
import pytest
from PIL import Image
from rosbags.highlevel import AnyReader
from session_files import EPOCH, PERIOD, TYPES, image, press, write

from us_sim.command.main import main
from us_sim.recording.reader import read_bag
from us_sim.recording.schemas import load_jazzy_definitions
from us_sim.recording.writer import BagWriter

SPACING = (0.4e-3, 0.25e-3)  # m, of columns and of rows


def extracted(bag, out, *options):
    return main(["bag", "extract", str(bag), "--out", str(out), *options])


@pytest.fixture
def scaled(tmp_path):
    """A session of images whose scale is known: 40 of them, the last 20 at half the rate."""
    store = load_jazzy_definitions()
    to_probe = np.zeros((4, 4))
    to_probe[0, 0], to_probe[2, 1], to_probe[3, 3] = *SPACING, 1.0
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    array = store.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=to_probe.ravel())
    matrix = store.serialize_cdr(array, "std_msgs/msg/Float64MultiArray", little_endian=True)
    with BagWriter(tmp_path / "s.mcap", sidecar=False) as bag:
        bag.add_topic("/ultrasound/image", TYPES["/ultrasound/image"])
        bag.add_topic("/ultrasound/image_to_probe", "std_msgs/msg/Float64MultiArray")
        bag.write_message("/ultrasound/image_to_probe", matrix, EPOCH)
        for k in range(40):
            stamp = EPOCH + (k + max(k - 20, 0)) * PERIOD
            bag.write_message(
                "/ultrasound/image", image(stamp, np.full((48, 64), 6 * k)), stamp + 1
            )
    return tmp_path / "s.mcap"


def test_real_poses_are_what_rosbags_decodes(shared_data, tmp_path):
    folder = shared_data / "ros2-jazzy/bags/probe_path_mcap"
    assert extracted(folder, tmp_path, "--poses") == 0
    with AnyReader([folder]) as reader:
        chosen = [each for each in reader.connections if each.topic == "/tracker/pose"]
        decoded = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(chosen)]
    poses = [(each.pose.position, each.pose.orientation) for each in decoded]
    numbers = [(p.x, p.y, p.z, q.x, q.y, q.z, q.w) for p, q in poses]
    stamps = [(each.header.stamp.sec, each.header.stamp.nanosec) for each in decoded]
    with (tmp_path / "tracker_pose.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [tuple(map(int, row["stamp_s"].split("."))) for row in rows] == stamps
    columns = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    assert [tuple(float(row[name]) for name in columns) for row in rows] == numbers


def test_wrenches_are_in_newtons(tmp_path):
    assert extracted(write(tmp_path / "s.mcap", press(60)), tmp_path, "--wrench") == 0
    with (tmp_path / "probe_wrench.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    forces = [float(row["fz_n"]) for row in rows]
    assert forces == pytest.approx(-8 * np.sin(np.pi * np.arange(60) / 60))
    assert rows[1]["stamp_s"] == "1700000000.016666667"


def test_images_are_what_was_recorded_with_their_scale(scaled, tmp_path):
    assert extracted(scaled, tmp_path / "out", "--images") == 0
    files = sorted((tmp_path / "out" / "ultrasound_image").iterdir())
    assert len(files) == 40
    for k, file in enumerate(files):
        with Image.open(file) as picture:
            assert (np.array(picture) == 6 * k).all()
            across, down = (0.0254 / each for each in picture.info["dpi"])
            # PNG has whole pixels a metre.
            assert (across, down) == pytest.approx(SPACING, rel=1e-3)
    assert cv2.imread(str(files[7]), cv2.IMREAD_UNCHANGED).shape == (48, 64)
    with (tmp_path / "out" / "ultrasound_image.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert (rows[1]["image"], rows[1]["stamp_s"]) == ("000001.png", "1700000000.016666667")


def test_real_images_have_no_scale_that_nobody_recorded(shared_data, tmp_path):
    folder = shared_data / "ros2-jazzy/bags/probe_path_mcap"
    assert extracted(folder, tmp_path, "--images") == 0
    files = sorted((tmp_path / "camera_image_raw").iterdir())
    assert len(files) == 68
    with Image.open(files[0]) as picture:
        assert picture.size == (64, 48)
        assert "dpi" not in picture.info
    with (tmp_path / "camera_image_raw.csv").open() as stream:
        assert next(csv.DictReader(stream))["row_spacing_mm"] == ""


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--poses", "holds no poses"),
        ("--areas", "holds no scene attached"),
    ],
)
def test_what_a_recording_has_not(tmp_path, capsys, option, said):
    with BagWriter(tmp_path / "s.mcap", sidecar=False) as bag:
        bag.add_topic("/note", "std_msgs/msg/String")
    assert extracted(tmp_path / "s.mcap", tmp_path / "out", option) == 1
    assert said in capsys.readouterr().err


def test_all_that_a_recording_lacks_is_named_and_nothing_written(tmp_path, capsys):
    session = write(tmp_path / "s.mcap", [each for each in press(3) if each[0] == "/probe/pose"])
    assert extracted(session, tmp_path / "out", "--poses", "--wrench", "--images") == 1
    assert "no wrench and no image; leave out --wrench and --images" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_images_that_cannot_be_decoded_are_told(shared_data, tmp_path, capsys):
    extracted(shared_data / "cases" / "bag-every-type/test_bag_mcap", tmp_path, "--images")
    assert "/test/sensor_msgs/image: 2 images skipped" in capsys.readouterr().out


def test_nothing_is_overwritten(scaled, tmp_path, capsys):
    out = tmp_path / "out"
    assert extracted(scaled, out, "--images") == 0
    assert extracted(scaled, out, "--images") == 1
    assert "exists already: choose another folder with --out" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert extracted(scaled, tmp_path / "file", "--images") == 1
    assert "cannot be written" in capsys.readouterr().err


def test_attached_files_as_before_without_an_option(tmp_path):
    session = write(tmp_path / "s.mcap", press(3), {"note.txt": b"hello"})
    assert extracted(session, tmp_path / "out") == 0
    assert (tmp_path / "out" / "note.txt").read_bytes() == b"hello"
    assert read_bag(session).attachments.keys() == {"note.txt"}
