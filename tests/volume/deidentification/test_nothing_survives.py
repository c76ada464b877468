"""No text and no identifier of an original is in any byte of what an import writes."""

import gzip
import re
import warnings
from pathlib import Path

import numpy as np
import pydicom
import pytest
from made_dicom import US_MULTI_FRAME, compressed, enhanced, header, item, turned, write
from pydicom.uid import RLELossless

from us_sim.command.main import main
from us_sim.errors import UsSimError
from us_sim.volume.deidentification.importing import look_at
from us_sim.volume.deidentification.settings import ImportSettings

BUNDLED = Path(pydicom.__path__[0]) / "data" / "test_files"
WHOLE = ImportSettings(keep_whole_image=True)
TEXTS = ("AE", "AS", "CS", "DA", "DT", "LO", "LT", "PN", "SH", "ST", "TM")
TEXTS += ("UC", "UI", "UR", "UT", "UN", "OB")


def texts_of(header):
    """Every text in a header, those in private elements and sequences too."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for element in [*getattr(header, "file_meta", []), *header.iterall()]:
            if element.VR in TEXTS and element.value and element.keyword != "PixelData":
                one = isinstance(element.value, str | bytes) or not hasattr(
                    element.value, "__iter__"
                )
                for value in [element.value] if one else element.value:
                    yield value.decode("latin-1") if isinstance(value, bytes) else str(value)


def telling(path):
    """Words of four letters or more, identifiers and long numbers of an original."""
    telling = r"[^\W\d_]{4,}|[0-9]+(?:\.[0-9]+){4,}|[0-9]{7,}"
    texts = texts_of(pydicom.dcmread(path, force=True))
    return {word for text in texts for word in re.findall(telling, text)}


def written(folder):
    """All bytes of all files: headers with the files' names, and voxels; packed ones unpacked."""
    headers, voxels = b"", b""
    for file in sorted(folder.rglob("*")):
        headers += file.name.encode() + b"\n"
        if not file.is_file():
            continue
        content = file.read_bytes()
        content = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
        ends = {".nrrd": b"\n\n", ".mha": b"ElementDataFile = LOCAL\n"}
        end = ends.get(file.suffix)
        at = content.index(end) + len(end) if end else 352 if ".nii" in file.name else len(content)
        headers, voxels = headers + content[:at], voxels + content[at:]
    return headers, voxels


@pytest.fixture(scope="module")
def own_words(tmp_path_factory):
    """Words that we write whatever is imported."""
    folder = tmp_path_factory.mktemp("own")
    made = enhanced(np.full((3, 3, 3), 200, np.uint8), turned())
    path = write(folder / "a.dcm", made)
    out = folder / "out"
    out.mkdir()
    for name in ("o.nrrd", "o.mha", "o.nii.gz", "case"):
        look_at([path], out / name, WHOLE).write()
    flat = write(
        folder / "b.dcm", header(np.zeros((2, 3, 3), np.uint8), US_MULTI_FRAME, PixelSpacing=[1, 1])
    )
    look_at([flat], out / "o.igs.mha", WHOLE).write()
    return set(re.findall(r"[A-Za-z]{4,}", written(out)[0].decode("latin-1")))


def survivors(telling_words, data, own):
    """Words of an original that headers hold beside our own, or voxels, if these are no chance."""
    headers, voxels = (part.decode("latin-1") for part in data)
    ours = sorted(own, key=len, reverse=True)
    rest = re.sub("|".join(map(re.escape, ours)), " ", headers).lower()
    forms = {word: word.encode().decode("latin-1") for word in telling_words}
    found = {word for word, form in forms.items() if form.lower() in rest}
    long = {word: form for word, form in forms.items() if len(word) > 5 and len(set(word)) > 3}
    return found | {word for word, form in long.items() if form in voxels}


def import_whole(path, out):
    """Import with a person's spacing where the file does not state it."""
    try:
        look_at([path], out, WHOLE).write()
    except UsSimError as error:
        if "--spacing X,Y" not in str(error):
            raise
        look_at([path], out, ImportSettings(keep_whole_image=True, spacing="1,1")).write()


@pytest.mark.slow
def test_of_every_file_that_comes_with_pydicom(tmp_path, own_words):
    imported, sentences = 0, []
    bundled = sorted(p for p in BUNDLED.rglob("*") if p.is_file() and p.suffix in (".dcm", ""))
    for number, path in enumerate(bundled):
        out = tmp_path / str(number)
        out.mkdir()
        try:
            import_whole(path, out / ("o.igs.mha", "o.mha")[number % 2])
        except UsSimError as error:
            sentences.append(str(error))
            assert not list(out.iterdir())
            continue
        imported += 1
        assert not survivors(telling(path), written(out), own_words), path
    assert all("\n" not in sentence for sentence in sentences)
    assert imported > 70
    assert len(sentences) > 10  # structured reports, directories and the like hold no image


@pytest.mark.parametrize("number", range(6))
def test_of_every_real_ultrasound_file(shared_file, tmp_path, own_words, number, capsys):
    folder = shared_file("dicom-us-2d")
    path = sorted(folder.glob("*.dcm"))[number]
    out = tmp_path / "out"
    out.mkdir()
    arguments = ["import", str(path), "--out", f"{out}/o.igs.mha", "--keep-whole-image"]
    assert 0 in (main(arguments), main([*arguments, "--spacing", "1,1"]))
    said = capsys.readouterr().out.replace(str(out), "").encode()
    own = own_words | set(re.findall(r"[A-Za-z]{4,}", said.decode()))
    secret = telling(path)
    assert len(secret) > 10
    assert not survivors(secret, written(out), own)
    assert not {word for word in secret - own if len(word) > 5 and word.encode() in said}


PLANTED = "Zyxwoman"


def planted(made):
    """Plant a name in every kind of text, in private elements, sequences, overlays and beyond."""
    values = {
        "PatientName": f"{PLANTED}^Quorra",
        "InstitutionName": f"{PLANTED} Clinic",
        "PatientComments": f"born {PLANTED}",
        "StationName": PLANTED,
        "RetrieveURL": f"http://{PLANTED}.org",
        "TransducerType": f"{PLANTED}",
        "DepthOfScanField": 982791357,  # long, lest a random UID holds it
        "StudyDate": "19710203",
        "LongCodeValue": PLANTED * 40,
        "ImageComments": PLANTED,
        "BodyPartExamined": PLANTED.upper(),
    }
    for key, value in values.items():
        setattr(made, key, value)
    for tag, kind in ((0x00091001, "LO"), (0x00091002, "UN"), (0x00091003, "OB")):
        made.add_new(tag, kind, PLANTED if kind == "LO" else PLANTED.encode() + b"\0" * 4)
    made.add_new(0x0020000D, "UI", f"1.2.0123.{PLANTED}")  # of which pydicom warns, and shows it
    made.add_new(0x00090010, "LO", f"{PLANTED} CREATOR")
    inner = item(
        CodeMeaning=PLANTED, RequestAttributesSequence=[item(RequestedProcedureID=PLANTED)]
    )
    made.AnatomicRegionSequence = [inner]
    made.add_new(0x60003000, "OW", PLANTED.encode())
    made.add_new(0x60004000, "LT", PLANTED)
    made.DataSetTrailingPadding = PLANTED.encode() * 3
    made.preamble = (PLANTED.encode() * 20)[:128]
    return made


def test_of_a_volume_with_names_in_every_place(tmp_path, own_words):
    voxels = np.random.default_rng(2).integers(0, 256, (9, 8, 7), dtype=np.uint8)
    path = write(tmp_path / "a.dcm", planted(enhanced(voxels, turned(), times=2)))
    assert path.read_bytes().count(PLANTED.encode()) > 50
    for name in ("o.nrrd", "o.mha", "o.nii", "o.nii.gz", "arm"):
        out = tmp_path / f"out {name}"
        out.mkdir()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            found = look_at([path], out / name, ImportSettings())
            found.write()
        assert not [one for one in warned if PLANTED in str(one.message)]
        assert not survivors(telling(path), written(out), own_words), name
        assert PLANTED.lower() not in found.said.lower()
        assert b"982791357" not in written(out)[0]


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii.gz"])
def test_of_other_formats_nothing_but_the_grid_goes_on(tmp_path, suffix):
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(np.arange(60, dtype=np.uint8).reshape(5, 4, 3))
    image.SetSpacing((0.5, 0.25, 2.0))
    for key in ("Comment", "0010|0010", PLANTED, "descrip", "aux_file", "intent_name"):
        image.SetMetaData(key, PLANTED)
    path = tmp_path / f"a{suffix}"
    sitk.WriteImage(image, str(path))
    assert PLANTED.encode() in b"".join(written(tmp_path))
    out = tmp_path / "out"
    out.mkdir()
    found = look_at([path], out / "o.nrrd", ImportSettings())
    found.write()
    assert PLANTED.encode() not in b"".join(written(out))
    assert PLANTED not in found.said
    again = sitk.ReadImage(str(out / "o.nrrd"))
    assert again.GetSpacing() == pytest.approx((0.5, 0.25, 2.0))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(again), sitk.GetArrayFromImage(image))


@pytest.mark.parametrize("kind", ["grey", "colour", "packed"])
def test_burned_in_text_is_gone_from_every_image(tmp_path, kind):
    frames = np.random.default_rng(7).integers(0, 120, (5, 40, 60), dtype=np.uint8)
    frames[:, :8] = frames[:, :, :6] = 255  # stands for text
    pixels = np.repeat(frames[..., None], 3, axis=3) if kind == "colour" else frames
    made = header(pixels, US_MULTI_FRAME, PixelSpacing=[1, 1])

    def edges(*values):
        keys = [f"RegionLocation{key}" for key in ("MinX0", "MinY0", "MaxX1", "MaxY1")]
        return dict(zip(keys, values, strict=True))

    made.SequenceOfUltrasoundRegions = [
        item(RegionSpatialFormat=1, RegionDataType=1, **edges(6, 8, 49, 39)),
        item(RegionSpatialFormat=0, RegionDataType=13, **edges(0, 0, 5, 39)),
    ]
    if kind == "packed":
        path = write(tmp_path / "a.dcm", compressed(made, RLELossless), RLELossless)
    else:
        path = write(tmp_path / "a.dcm", made)
    look_at([path], tmp_path / "o.igs.mha", ImportSettings()).write()
    kept = (tmp_path / "o.igs.mha").read_bytes()[-frames.size :]
    expected = np.zeros_like(frames)
    expected[:, 8:40, 6:50] = frames[:, 8:40, 6:50]
    np.testing.assert_array_equal(np.frombuffer(kept, np.uint8).reshape(frames.shape), expected)
