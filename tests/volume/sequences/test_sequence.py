"""Tracked sequences: the same frames from every format and orientation, and from real files."""

import gzip
import zlib

import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import VolumeError
from us_sim.volume.sequences.sequence import read_sequence
from us_sim.volume.sequences.sweep import read_sweep, sweep_of
from us_sim.volume.sequences.transforms import in_metres, split_transform_name

GREY = np.random.Generator(np.random.PCG64(5)).integers(0, 256, (3, 4, 5), dtype=np.uint8)
POSES = [f"0.2 0 0 {k} 0 0 -0.2 0 0 0.2 0 30 0 0 0 1" for k in range(3)]

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


def frame_fields():
    """What Plus writes of each frame."""
    for k, pose in enumerate(POSES):
        yield f"Seq_Frame{k:04d}_ImageToReferenceTransform", pose
        yield f"Seq_Frame{k:04d}_Timestamp", f"{10 + k / 10}"
        yield f"Seq_Frame{k:04d}_ImageStatus", "OK"


def metaimage(path, stored, orientation="MF", **more):
    rows, columns = stored.shape[1:3]
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "DimSize": f"{columns} {rows} {len(stored)}",
        "ElementType": "MET_UCHAR",
        "Kinds": "domain domain list",
        "UltrasoundImageOrientation": orientation,
        **more,
        **dict(frame_fields()),
        "ElementDataFile": "LOCAL",
    }
    packed = more.get("CompressedData") == "True"
    data = zlib.compress(stored.tobytes()) if packed else stored.tobytes()
    path.write_bytes("".join(f"{k} = {v}\n" for k, v in header.items()).encode() + data)
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


def in_two_members(data):
    """As IGSIO packs, which opens its file again for further frames."""
    return gzip.compress(data[:37]) + gzip.compress(data[37:])


@pytest.mark.parametrize("orientation", STORED)
def test_images_are_turned_as_their_orientation_says(tmp_path, orientation):
    stored = np.array([STORED[orientation](image) for image in GREY])
    sequence = read_sequence(metaimage(tmp_path / "a.igs.mha", stored, orientation))
    assert (sequence.rows, sequence.columns) == GREY.shape[1:]
    np.testing.assert_array_equal(list(sequence.images()), GREY)


@pytest.mark.parametrize("pack", [None, gzip.compress, in_two_members])
def test_nrrd_holds_what_metaimage_holds(tmp_path, pack):
    of_mha = read_sweep(metaimage(tmp_path / "a.mha", GREY, CompressedData="True"))
    of_nrrd = read_sweep(nrrd(tmp_path / "a.igs.nrrd", GREY, pack))
    for name in ("times", "numbers", "image_to_reference"):
        np.testing.assert_array_equal(getattr(of_mha, name), getattr(of_nrrd, name))
    for sweep in (of_mha, of_nrrd):
        np.testing.assert_array_equal(list(sweep.images([2, 0])), GREY[[0, 2]])


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
    assert [int(image[1, 2]) for image in sequence.images()] == [76, 150, 90]


@pytest.mark.parametrize("kind", ["<u2", ">i2", "<f4"])
def test_images_of_more_than_8_bits_are_spread_over_all_frames(tmp_path, kind):
    deep = (GREY.astype(float) * 100).astype(kind)
    order = "True" if kind[0] == ">" else "False"
    element = {"u2": "MET_USHORT", "i2": "MET_SHORT", "f4": "MET_FLOAT"}[kind[1:]]
    more = {"ElementType": element, "BinaryDataByteOrderMSB": order}
    sequence = read_sequence(metaimage(tmp_path / "a.mha", deep, **more))
    scaled = (GREY - float(GREY.min())) / np.ptp(GREY) * 255.0
    np.testing.assert_array_equal(list(sequence.images()), np.floor(scaled + 0.5))


def test_a_flat_sequence_of_two_dimensions_is_that_of_three(tmp_path):
    path = nrrd(tmp_path / "a.igs.nrrd", GREY, kinds="domain domain list", sizes="5 4 3")
    flat = "space dimension: 2\nspace directions: (1,0) (0,1) none\nspace origin: (0,0)\n"
    content = path.read_bytes().replace(b"encoding: ", f"{flat}encoding: ".encode())
    old = content.replace(b"UltrasoundImageOrientation:=MFA", b"ultrasound image orientation:=UFA")
    path.write_bytes(old)
    np.testing.assert_array_equal(list(read_sweep(path).images()), GREY[:, :, ::-1])


def test_a_real_flat_sequence_of_plus_has_the_images_that_itk_reads(shared_data):
    path = shared_data / "foreign-files" / "NwirePhantomFreehand.igs.nrrd"
    if not path.exists():
        pytest.skip(f"no {path}")
    sequence = read_sequence(path)
    assert (sequence.columns, sequence.rows, len(sequence)) == (820, 616, 97)
    stored = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))  # (row, column, frame)
    (image,) = sequence.images([50])
    np.testing.assert_array_equal(image, stored[:, :, 50])


def test_plus_rule_for_names():
    for name, ends in {
        "ProbeToTracker": ("Probe", "Tracker"),
        "ToolToTracker": ("Tool", "Tracker"),
        "TestToolToTracker": ("TestTool", "Tracker"),
        "ToolTipToTorso": ("ToolTip", "Torso"),
        "ImageTo3DWorld": ("Image", "3DWorld"),
        "probeToTracker": ("Probe", "Tracker"),
        "AToBToC": None,
        "Torso": None,
        "ToTracker": None,
        "ProbeTo": None,
    }.items():
        assert split_transform_name(name) == ends, name


def test_a_chain_by_way_of_the_tracker_places_images_of_plus_as_its_formula_says(shared_data):
    path = shared_data / "plus-spine-freehand" / "SpinePhantomFreehand.igs.mha"
    if not path.exists():
        pytest.skip(f"no {path}")
    sequence = read_sequence(path)
    calibration = np.diag([0.08, 0.08, 0.08, 1.0])
    calibration[:3, 3] = (15.4, 49.6, -8.6)  # mm
    sweep = sweep_of(sequence, calibration={"ImageToProbe": in_metres("ImageToProbe", calibration)})
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kinds": "list domain domain domain"}, "along another axis than the last"),
        ({"kinds": "domain domain domain domain"}, "is a volume"),
        ({"sizes": "5 4 2 3"}, "is a sequence of volumes"),
        ({"sizes": "5 4 1 4000000"}, "says it holds 4000000 frames"),
        ({"sizes": "5 4 1 8"}, "holds 60 bytes of image data where its header says 160"),
        ({"sizes": "5 four 1 3"}, "where a sequence has columns, rows and frames"),
    ],
)
def test_an_nrrd_file_of_another_kind_is_refused(tmp_path, change, message):
    path = nrrd(tmp_path / "a.nrrd", GREY, **change)
    with pytest.raises(VolumeError, match=message) as refused:
        read_sweep(path)
    assert str(refused.value).startswith(f"{path}: ")
