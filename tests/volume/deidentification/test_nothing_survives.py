"""No text and no identifier of an original is in any byte of what an import writes."""

import gzip
import re
import warnings
from pathlib import Path

import numpy as np
import pydicom
import pytest
from made_dicom import compressed, enhanced, item, turned, write
from pydicom.uid import RLELossless

from us_sim.command.main import main
from us_sim.errors import UsSimError
from us_sim.volume.deidentification.importing import plan_import
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
        plan_import([path], out / name, WHOLE).write()
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


@pytest.mark.slow
def test_every_file_that_comes_with_pydicom_is_imported_or_refused_in_a_sentence(
    tmp_path, own_words
):
    imported, sentences = 0, []
    bundled = sorted(p for p in BUNDLED.rglob("*") if p.is_file() and p.suffix in (".dcm", ""))
    assert len(bundled) > 80
    for number, path in enumerate(bundled):
        out = tmp_path / str(number)
        out.mkdir()
        try:
            plan_import([path], out / "o.mha", WHOLE).write()
        except UsSimError as error:
            sentences.append(str(error))
            assert not list(out.iterdir())
            continue
        imported += 1
        assert not survivors(telling(path), written(out), own_words), path
    assert all("\n" not in sentence for sentence in sentences)
    assert imported  # most are single images


@pytest.mark.parametrize("number", range(6))
def test_a_refusal_of_a_real_2d_file_says_nothing_of_its_header(
    shared_file, tmp_path, number, capsys
):
    path = sorted(shared_file("dicom-us-2d").glob("*.dcm"))[number]
    out = tmp_path / "o.mha"
    assert main(["import", str(path), "--out", str(out), "--keep-whole-image"]) == 1
    said = capsys.readouterr().err
    assert "not a volume" in said or "no volume" in said
    assert not out.exists()
    secret = telling(path)
    assert len(secret) > 10
    told = said.replace(str(path), "")
    assert not {word for word in secret if len(word) > 6 and word in told}


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
            found = plan_import([path], out / name, ImportSettings())
            found.write()
        assert not [one for one in warned if PLANTED in str(one.message)]
        assert not survivors(telling(path), written(out), own_words), name
        assert PLANTED.lower() not in found.summary.lower()
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
    found = plan_import([path], out / "o.nrrd", ImportSettings())
    found.write()
    assert PLANTED.encode() not in b"".join(written(out))
    assert PLANTED not in found.summary
    again = sitk.ReadImage(str(out / "o.nrrd"))
    assert again.GetSpacing() == pytest.approx((0.5, 0.25, 2.0))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(again), sitk.GetArrayFromImage(image))


@pytest.mark.parametrize("is_packed", [False, True])
def test_burned_in_text_is_gone_from_every_image(tmp_path, is_packed):
    voxels = np.random.default_rng(7).integers(0, 120, (60, 40, 5), dtype=np.uint8)
    voxels[:6] = voxels[:, :8] = 255  # stands for text
    made = enhanced(voxels, turned())
    edges = {"MinX0": 6, "MinY0": 8, "MaxX1": 49, "MaxY1": 39}
    stated = {f"RegionLocation{key}": value for key, value in edges.items()}
    made.SequenceOfUltrasoundRegions = [item(RegionSpatialFormat=1, RegionDataType=1, **stated)]
    if is_packed:
        path = write(tmp_path / "a.dcm", compressed(made, RLELossless), RLELossless)
    else:
        path = write(tmp_path / "a.dcm", made)
    plan_import([path], tmp_path / "o.mha", ImportSettings()).write()
    kept = (tmp_path / "o.mha").read_bytes()[-voxels.size :]
    expected = np.zeros_like(voxels)
    expected[6:50, 8:] = voxels[6:50, 8:]
    found = np.frombuffer(kept, np.uint8).reshape(voxels.shape, order="F")
    np.testing.assert_array_equal(found, expected)
