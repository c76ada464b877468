"""Tracked sweeps: sequence files written field by field, and real ones against SimpleITK."""

import tracemalloc
import zlib

import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import VolumeError
from us_sim.volume.sequences.sweep import read_sweep

COLUMNS, ROWS, FRAMES = 5, 4, 3
GREY = np.random.Generator(np.random.PCG64(5)).integers(
    0, 256, (FRAMES, ROWS, COLUMNS), dtype=np.uint8
)
MATRIX = "0.2 0 0 {x} 0 0 -0.2 0 0 0.2 0 30 0 0 0 1"


def _sequence(path, data=None, frames=None, data_file="LOCAL", **fields):
    """A sequence file as Plus writes it; a field that is None is left out."""
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "CompressedData": "False",
        "DimSize": f"{COLUMNS} {ROWS} {FRAMES}",
        "UltrasoundImageOrientation": "MFA",
        "ElementType": "MET_UCHAR",
        **fields,
    }
    for k in range(FRAMES):
        frame = {
            "ImageToReferenceTransform": MATRIX.format(x=k),
            "ImageToReferenceTransformStatus": "OK",
            "Timestamp": f"{10 + k / 10}",
            "ImageStatus": "OK",
            **(frames or {}).get(k, {}),
        }
        header |= {f"Seq_Frame{k:04d}_{key}": value for key, value in frame.items()}
    header["ElementDataFile"] = data_file  # ends the header
    text = "".join(f"{key} = {value}\n" for key, value in header.items() if value is not None)
    path.write_bytes(text.encode() + (GREY.tobytes() if data is None else data))
    return path


@pytest.mark.parametrize("compressed", [False, True])
def test_images_poses_and_times(tmp_path, compressed):
    data = zlib.compress(GREY.tobytes())
    fields = {"CompressedData": "True", "CompressedDataSize": str(len(data))}
    path = tmp_path / "a.igs.mha"
    sweep = read_sweep(_sequence(path, data, **fields) if compressed else _sequence(path))
    assert (sweep.columns, sweep.rows, sweep.left_out) == (COLUMNS, ROWS, {})
    np.testing.assert_allclose(sweep.times, [10.0, 10.1, 10.2])
    np.testing.assert_array_equal(np.array(list(sweep.images())), GREY)
    np.testing.assert_array_equal(np.array(list(sweep.images([2, 0]))), GREY[[0, 2]])
    # Column 4 and row 3 of frame 1: 1 + 0.2 * 4 mm, 0, 30 + 0.2 * 3 mm.
    np.testing.assert_allclose(
        sweep.image_to_reference[1] @ [4, 3, 0, 1], [1.8e-3, 0.0, 30.6e-3, 1.0], atol=1e-15
    )


def test_images_may_lie_in_a_file_beside_the_header(tmp_path):
    (tmp_path / "a.raw").write_bytes(GREY.tobytes())
    sweep = read_sweep(_sequence(tmp_path / "a.mhd", b"", data_file="a.raw"))
    np.testing.assert_array_equal(next(sweep.images([1])), GREY[1])
    (tmp_path / "a.raw").unlink()
    with pytest.raises(VolumeError, match=r"a\.raw, which is not there"):
        read_sweep(tmp_path / "a.mhd")


UNUSABLE = "a transform that is singular or not finite"


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        ({"ImageToReferenceTransform": None}, "no ImageToReferenceTransform"),
        ({"ImageToReferenceTransform": "1 0 0"}, "a transform that is not 16 numbers"),
        ({"ImageToReferenceTransform": "1 0 x " + "0 " * 13}, "a transform that is not 16 numbers"),
        ({"ImageToReferenceTransform": " ".join("0" * 16)}, UNUSABLE),
        ({"ImageToReferenceTransform": MATRIX.format(x="nan")}, UNUSABLE),
        ({"ImageToReferenceTransform": MATRIX.format(x="inf")}, UNUSABLE),
        ({"ImageToReferenceTransform": "1 1 0 0 1 1 0 0 0 0 1 0 0 0 0 1"}, UNUSABLE),
        (
            {"ImageToReferenceTransformStatus": "INVALID"},
            "ImageToReferenceTransformStatus is not OK",
        ),
        ({"ImageStatus": "INVALID"}, "ImageStatus is not OK"),
        ({"Timestamp": None}, "no Timestamp"),
        ({"Timestamp": "nan"}, "no Timestamp"),
        ({"Timestamp": "soon"}, "no Timestamp"),
    ],
)
def test_a_frame_that_cannot_be_used_is_left_out_and_counted(tmp_path, broken, reason):
    sweep = read_sweep(_sequence(tmp_path / "a.mha", frames={1: broken}))
    assert sweep.left_out == {reason: 1}
    assert sweep.numbers.tolist() == [0, 2]
    np.testing.assert_array_equal(np.array(list(sweep.images())), GREY[[0, 2]])
    np.testing.assert_allclose(sweep.image_to_reference[:, 0, 3], [0.0, 2e-3])


@pytest.mark.parametrize("missing", ["ImageStatus", "ImageToReferenceTransformStatus"])
def test_a_status_that_is_not_written_is_good(tmp_path, missing):
    sweep = read_sweep(_sequence(tmp_path / "a.mha", frames={0: {missing: None}}))
    assert len(sweep.numbers) == FRAMES


def test_frames_that_the_header_does_not_describe_are_counted(tmp_path):
    path = _sequence(tmp_path / "a.mha", DimSize=f"{COLUMNS} 2 6")
    sweep = read_sweep(path)
    assert len(sweep.numbers) == FRAMES
    assert sweep.left_out == {"no field in the header": 3}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"DimSize": None}, "DimSize"),
        ({"DimSize": "5 4"}, "DimSize"),
        ({"DimSize": "5 four 3"}, "DimSize"),
        ({"DimSize": "5 4 4"}, "60 bytes .* 80"),
        ({"DimSize": "0 0 3"}, "without images"),
        ({"DimSize": "5 -4 3"}, "without images"),
        ({"DimSize": "5 2 2 3"}, "sequence of volumes"),
        ({"ElementType": "MET_SHORT"}, "60 bytes .* 120"),
        ({"ElementType": None}, "ElementType"),
        ({"ElementNumberOfChannels": "2"}, "2 numbers"),
        ({"UltrasoundImageOrientation": "AMF"}, "'AMF'"),
    ],
)
def test_a_sequence_of_another_kind_is_refused(tmp_path, fields, message):
    path = _sequence(tmp_path / "bad.mha", **fields)
    with pytest.raises(VolumeError, match=message) as refused:
        read_sweep(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


def test_a_sequence_whose_images_are_not_calibrated_is_refused(tmp_path):
    fields = {"ImageToReferenceTransform": None, "ProbeToTrackerTransform": MATRIX.format(x=0)}
    path = _sequence(tmp_path / "a.mha", frames=dict.fromkeys(range(FRAMES), fields))
    with pytest.raises(VolumeError, match=r"Image to Reference.* ProbeToTracker: .*calibration"):
        read_sweep(path)


def test_damaged_compression_is_noticed_where_the_images_are_read(tmp_path):
    data = bytearray(zlib.compress(GREY.tobytes()))
    fields = {"CompressedData": "True", "CompressedDataSize": str(len(data))}
    data[20:40] = bytes(20)
    sweep = read_sweep(_sequence(tmp_path / "a.mha", bytes(data), **fields))
    with pytest.raises(VolumeError, match="compression"):
        list(sweep.images())
    short = zlib.compress(GREY[:2].tobytes())
    fields["CompressedDataSize"] = str(len(short))
    sweep = read_sweep(_sequence(tmp_path / "b.mha", short, **fields))
    with pytest.raises(VolumeError, match="40 bytes"):
        list(sweep.images())


def test_what_is_no_sequence_is_refused(tmp_path):
    for content in (b"", b"no image at all\n" * 40, bytes(4096), b"a = b\n"):
        path = tmp_path / "a.mha"
        path.write_bytes(content)
        with pytest.raises(VolumeError, match="give a sequence"):
            read_sweep(path)
    for path in (tmp_path / "nowhere.mha", tmp_path):
        with pytest.raises(VolumeError, match="no such file"):
            read_sweep(path)


def test_the_real_liver_sweep_is_what_simpleitk_reads(shared_file):
    path = shared_file("imfusion-liver-sweep/liver_sweep.igs.mha")
    sweep = read_sweep(path)
    assert (sweep.columns, sweep.rows, len(sweep.numbers)) == (739, 593, 140)
    assert (sweep.times[0], sweep.times[-1]) == (0.0, 6.084)
    sizes = np.linalg.norm(sweep.image_to_reference[:, :3, :2], axis=1)
    np.testing.assert_allclose(sizes, 0.314818e-3, rtol=1e-6)  # as its source states
    stored = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))
    tracemalloc.start()
    for k, image in enumerate(sweep.images()):
        assert np.array_equal(image, stored[k])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8e6  # of 61 MB


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("plus-spine-freehand/SpinePhantomFreehand.igs.mha", "ProbeToTracker, Ref"),
        ("plus-tracker-recordings/ReferenceToRASCalibration.igs.mha", "without images"),
        ("plus-tracker-recordings/TransformInterpolationTest.igs.mha", "ProbeToTracker, Ref"),
        (
            "plus-tracker-recordings/WaterTankBottomTranslationVideoBuffer.igs.mha",
            "no transforms",
        ),
        ("imfusion-liver-sweep/liver_sweep_compounded_1mm.mha", "tracked frames"),
        ("plus-spine-freehand/VolumeReconstructorTestNNMEANvolumeRef.mha", "is a volume"),
    ],
)
def test_real_files_of_other_kinds_are_refused(shared_data, name, message):
    if not (shared_data / name).exists():
        pytest.skip(f"no {shared_data / name}")
    with pytest.raises(VolumeError, match=message):
        read_sweep(shared_data / name)


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ("100000 100000 3", "100000 × 100000"),
        ("5 4 9000000000", "9000000000 frames"),
        (":5 4 3", "DimSize"),
    ],
)
def test_a_sequence_that_says_it_is_vast_is_refused(tmp_path, size, message):
    data = zlib.compress(GREY.tobytes())
    fields = {"CompressedData": "True", "CompressedDataSize": str(len(data)), "DimSize": size}
    with pytest.raises(VolumeError, match=message):
        read_sweep(_sequence(tmp_path / "a.igs.mha", data, **fields))
