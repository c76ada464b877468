"""Tracked sequences: formats, orientations, broken ones, chains of transforms."""

import gzip
import zlib

import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import VolumeError
from us_sim.volume.sequences.sequence import read_sequence
from us_sim.volume.sequences.sweep import read_sweep
from us_sim.volume.sequences.transforms import to_metres

FRAMES, ROWS, COLUMNS = 3, 4, 5
GREY = np.random.default_rng(5).integers(0, 256, (FRAMES, ROWS, COLUMNS), dtype=np.uint8)
MATRIX = "0.2 0 0 {x} 0 0 -0.2 0 0 0.2 0 30 0 0 0 1"

# Where column c and row r of the image in MF are stored, as Plus names the orientations: the
# first letter is where columns lead to, the second where rows do.
STORED = {
    "MF": lambda image: image,
    "MFA": lambda image: image,
    "UF": lambda image: image[:, ::-1],
    "UFD": lambda image: image[:, ::-1],
    "MN": lambda image: image[::-1],
    "UN": lambda image: image[::-1, ::-1],
    "UNA": lambda image: image[::-1, ::-1],
    "FM": lambda image: image.T,
    "NM": lambda image: image.T[:, ::-1],
    "FU": lambda image: image.T[::-1],
    "NU": lambda image: image.T[::-1, ::-1],
}


def frame_fields(changes=None):
    """Fields of each frame as Plus writes them, but for changes; one that is None is left out."""
    for k in range(FRAMES):
        fields = {
            "ImageToReferenceTransform": MATRIX.format(x=k),
            "ImageToReferenceTransformStatus": "OK",
            "Timestamp": f"{10 + k / 10}",
            "ImageStatus": "OK",
            **(changes or {}).get(k, {}),
        }
        for key, value in fields.items():
            if value is not None:
                yield f"Seq_Frame{k:04d}_{key}", value


def metaimage(path, stored=GREY, data=None, frames=None, data_file="LOCAL", **fields):
    """A MetaImage sequence as Plus writes it; a field that is None is left out."""
    rows, columns = stored.shape[1:3]
    header = {"NDims": "3", "DimSize": f"{columns} {rows} {len(stored)}"}
    header |= {"ElementType": "MET_UCHAR", "UltrasoundImageOrientation": "MF", **fields}
    header |= {**dict(frame_fields(frames)), "ElementDataFile": data_file}  # ends the header
    text = "".join(f"{key} = {value}\n" for key, value in header.items() if value is not None)
    path.write_bytes(text.encode() + (stored.tobytes() if data is None else data))
    return path


def nrrd(path, stored, pack=None, *, kinds="domain domain domain list", sizes=None):
    rows, columns = stored.shape[1:3]
    sizes = sizes or f"{columns} {rows} 1 {len(stored)}"
    lines = ["NRRD0004", "# of Plus", "type: uint8", f"dimension: {len(sizes.split())}"]
    lines += [f"sizes: {sizes}", f"encoding: {'gzip' if pack else 'raw'}", f"kinds: {kinds}"]
    lines += ["UltrasoundImageOrientation:=MFA"]
    lines += [f"{key}:={value}" for key, value in frame_fields()]
    data = stored.tobytes()
    path.write_bytes("\n".join(lines).encode() + b"\n\n" + (pack(data) if pack else data))
    return path


def refused(path, message):
    """One sentence that begins with the file."""
    with pytest.raises(VolumeError, match=message) as error:
        list(read_sweep(path).read_images())
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("orientation", STORED)
def test_images_are_turned_as_their_orientation_says(tmp_path, orientation):
    stored = np.array([STORED[orientation](image) for image in GREY])
    path = metaimage(tmp_path / "a.igs.mha", stored, UltrasoundImageOrientation=orientation)
    sequence = read_sequence(path)
    assert (sequence.rows, sequence.columns) == GREY.shape[1:]
    np.testing.assert_array_equal(list(sequence.read_images()), GREY)


PACKED = zlib.compress(GREY.tobytes())
ENDINGS = {metaimage: "igs.mha", nrrd: "igs.nrrd"}
MEMBERS = [gzip.compress(part) for part in (GREY.tobytes()[:37], GREY.tobytes()[37:])]
"""As IGSIO packs, which opens its file again for further frames."""


@pytest.mark.parametrize(
    ("write", "how"),
    [
        (metaimage, {}),
        (metaimage, {"data": PACKED, "CompressedData": "True", "Kinds": "domain domain list"}),
        (nrrd, {"pack": lambda _: b"".join(MEMBERS)}),
        (nrrd, {"kinds": "domain domain list", "sizes": "5 4 3"}),
    ],
)
def test_images_poses_and_times_are_those_of_the_file(tmp_path, write, how):
    sweep = read_sweep(write(tmp_path / f"a.{ENDINGS[write]}", GREY, **how))
    assert (sweep.columns, sweep.rows, sweep.left_out) == (COLUMNS, ROWS, {})
    np.testing.assert_allclose(sweep.times, [10.0, 10.1, 10.2])
    np.testing.assert_array_equal(np.array(list(sweep.read_images())), GREY)
    np.testing.assert_array_equal(np.array(list(sweep.read_images([2, 0]))), GREY[[2, 0]])
    # Column 4 and row 3 of frame 1: 1 + 0.2 * 4 mm, 0, 30 + 0.2 * 3 mm.
    np.testing.assert_allclose(
        sweep.image_to_reference[1] @ [4, 3, 0, 1], [1.8e-3, 0.0, 30.6e-3, 1.0], atol=1e-15
    )


@pytest.mark.parametrize("write", [metaimage, nrrd])
def test_colours_are_made_grey_by_their_brightness(tmp_path, write):
    colours = np.zeros((3, 4, 5, 3), np.uint8)
    colours[0, 1, 2] = (255, 0, 0)  # red
    colours[1, 1, 2] = (0, 255, 0)
    colours[2, 1, 2] = (90, 90, 90)
    if write is metaimage:
        path = metaimage(tmp_path / "a.mha", colours, ElementNumberOfChannels="3")
    else:
        kinds = "vector domain domain domain list"
        path = nrrd(tmp_path / "a.nrrd", colours, kinds=kinds, sizes="3 5 4 1 3")
    sequence = read_sequence(path)
    assert sequence.are_colours
    # Rec. 601, luma: 0.299 R + 0.587 G + 0.114 B.
    assert [int(image[1, 2]) for image in sequence.read_images()] == [76, 150, 90]


@pytest.mark.parametrize("kind", ["<u2", ">i2", "<f4"])
def test_images_of_more_than_8_bits_are_spread_over_all_frames(tmp_path, kind):
    deep = (GREY.astype(float) * 100).astype(kind)
    order = "True" if kind[0] == ">" else "False"
    element = {"u2": "MET_USHORT", "i2": "MET_SHORT", "f4": "MET_FLOAT"}[kind[1:]]
    more = {"ElementType": element, "BinaryDataByteOrderMSB": order}
    sequence = read_sequence(metaimage(tmp_path / "a.mha", deep, **more))
    scaled = (GREY - float(GREY.min())) / np.ptp(GREY) * 255.0
    np.testing.assert_array_equal(list(sequence.read_images()), np.floor(scaled + 0.5))


def test_a_real_flat_sequence_of_plus_has_the_images_that_itk_reads(shared_file):
    path = shared_file("foreign-files/NwirePhantomFreehand.igs.nrrd")
    sequence = read_sequence(path)
    assert (sequence.columns, sequence.rows, len(sequence)) == (820, 616, 97)
    stored = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))  # (row, column, frame)
    (image,) = sequence.read_images([50])
    np.testing.assert_array_equal(image, stored[:, :, 50])


UNUSABLE = "a transform that is singular or not finite"


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        ({"ImageToReferenceTransform": None}, "no ImageToReferenceTransform"),
        ({"ImageToReferenceTransform": "1 0 x " + "0 " * 13}, "a transform that is not 16 numbers"),
        ({"ImageToReferenceTransform": "1 1 0 0 1 1 0 0 0 0 1 0 0 0 0 1"}, UNUSABLE),
        ({"ImageToReferenceTransformStatus": "BAD"}, "ImageToReferenceTransformStatus is not OK"),
        ({"Timestamp": "soon"}, "no Timestamp"),
    ],
)
def test_a_frame_that_cannot_be_used_is_left_out_and_counted(tmp_path, broken, reason):
    sweep = read_sweep(metaimage(tmp_path / "a.mha", frames={1: broken}))
    assert sweep.left_out == {reason: 1}
    assert sweep.numbers.tolist() == [0, 2]
    np.testing.assert_array_equal(np.array(list(sweep.read_images())), GREY[[0, 2]])
    np.testing.assert_allclose(sweep.image_to_reference[:, 0, 3], [0.0, 2e-3])


NO_IMAGE = {"ImageToReferenceTransform": None, "ProbeToTrackerTransform": MATRIX.format(x=0)}


@pytest.mark.parametrize(
    ("write", "fields", "message"),
    [
        (metaimage, {"DimSize": "5 4 4"}, "60 bytes .* 80"),
        (metaimage, {"UltrasoundImageOrientation": "AMF"}, "'AMF'"),
        (
            metaimage,
            {"frames": dict(enumerate([NO_IMAGE] * FRAMES))},
            "ProbeToTracker: .*calibr",
        ),
        (metaimage, {"data": b"", "data_file": "a.raw"}, r"a\.raw, which is not there"),
        (nrrd, {"kinds": "list domain domain domain"}, "is a volume"),
    ],
)
def test_a_sequence_of_another_kind_is_refused(tmp_path, write, fields, message):
    refused(write(tmp_path / f"a.{ENDINGS[write]}", GREY, **fields), message)


@pytest.mark.parametrize(
    ("data", "message"),
    [(PACKED[:20] + bytes(20) + PACKED[40:], "compression"), (zlib.compress(bytes(40)), "40 byt")],
)
def test_damaged_compression_is_noticed_where_the_images_are_read(tmp_path, data, message):
    sweep = read_sweep(metaimage(tmp_path / "a.mha", data=data, CompressedData="True"))
    with pytest.raises(VolumeError, match=message):
        list(sweep.read_images())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("plus-spine-freehand/SpinePhantomFreehand.igs.mha", "ProbeToTracker, Ref"),
        ("plus-tracker-recordings/WaterTankBottomTranslationVideoBuffer.igs.mha", "no transforms"),
        ("plus-spine-freehand", "no such file"),
    ],
)
def test_real_files_of_other_kinds_are_refused(shared_data, name, message):
    refused(shared_data / name, message)


def test_the_real_liver_sweep_is_what_simpleitk_reads(shared_file):
    path = shared_file("imfusion-liver-sweep/liver_sweep.igs.mha")
    sweep = read_sweep(path)
    assert (sweep.columns, sweep.rows, len(sweep.numbers)) == (739, 593, 140)
    assert (sweep.times[0], sweep.times[-1]) == (0.0, 6.084)
    sizes = np.linalg.norm(sweep.image_to_reference[:, :3, :2], axis=1)
    np.testing.assert_allclose(sizes, 0.314818e-3, rtol=1e-6)  # as its source states
    stored = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))
    for k, image in enumerate(sweep.read_images()):
        assert np.array_equal(image, stored[k])


def test_a_chain_by_way_of_the_tracker_places_images_of_plus_as_its_formula_says(shared_file):
    path = shared_file("plus-spine-freehand/SpinePhantomFreehand.igs.mha")
    calibration = np.diag([0.08, 0.08, 0.08, 1.0])
    calibration[:3, 3] = (15.4, 49.6, -8.6)  # mm
    sweep = read_sweep(path, calibration={"ImageToProbe": to_metres("ImageToProbe", calibration)})
    assert [name for name, _ in sweep.chain.steps] == [
        "ImageToProbe",
        "ProbeToTracker",
        "ReferenceToTracker",
    ]
    # p_Reference = inv(ReferenceToTracker) ProbeToTracker ImageToProbe p_Image, all in mm.
    text = path.open("rb").read(40000).decode("latin-1")
    matrices = {}
    for name in ("ProbeToTracker", "ReferenceToTracker"):
        line = text.split(f"Seq_Frame0007_{name}Transform = ")[1].split("\n")[0]
        matrices[name] = np.array(line.split(), float).reshape(4, 4)
    expected = np.linalg.solve(matrices["ReferenceToTracker"], matrices["ProbeToTracker"])
    expected = expected @ calibration @ [410, 300, 0, 1]
    found = sweep.image_to_reference[7] @ [410, 300, 0, 1]
    np.testing.assert_allclose(1e3 * found[:3], expected[:3], atol=1e-9)
