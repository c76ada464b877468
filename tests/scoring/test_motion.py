"""PerkTutor's published tables, met on its own recordings; movements whose speeds are known."""

import csv
import tempfile
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import ScoreError
from us_sim.geometry.mesh_file import read_with_meshio
from us_sim.scoring.metrics import Scan, Tally
from us_sim.scoring.motion import Motion

MM = 1e3


def motion(times, matrices):
    """Of the positions; ITK's matrices of images are no rotations."""
    return Motion(times, matrices[:, :3, 3], np.tile([0, 0, 0, 1], (len(times), 1)))


def table(moved):
    return {each.name: each.value for each in Tally().add_scan(Scan(moved)).list_metrics()}


def shown(times, time, tolerance=1e-3):
    """The sample of rising ``times`` that 3D Slicer shows at a time.

    Its sequence browser shows every device at the times of the first one: the sample within a
    millisecond if its search meets one, else the last one before (`GetItemNumberFromIndexValue` of
    vtkMRMLSequenceNode). PerkTutor measures what is shown, so of another device it counts the way
    between those samples alone.
    """
    first, last = 0, len(times) - 1
    if time <= times[first] + tolerance:
        return first
    if time >= times[last] - tolerance:
        return last
    while last - first > 1:
        middle = (first + last) // 2
        if abs(time - times[middle]) <= tolerance:
            return middle
        first, last = (middle, last) if time > times[middle] else (first, middle)
    return first


def lumbar(folder):
    """Matrices of both devices (m) at the times of the first, as 3D Slicer plays the recording."""
    rows = {}
    for log in ElementTree.parse(folder / "TransformBuffer_Lumbar_Anonymous.xml").getroot():
        time = int(log.get("TimeStampSec")) + 1e-9 * int(log.get("TimeStampNSec"))
        matrix = np.array(log.get("transform").split(), float).reshape(4, 4)
        matrix[:3, 3] /= MM
        # Slicer's stream writes six digits of the time.
        rows.setdefault(log.get("DeviceName"), []).append((float(f"{time:g}"), matrix))
    probe, stylus = (
        (np.array([t for t, _ in rows[name]]), np.array([m for _, m in rows[name]]))
        for name in ("ProbeToRAS", "StylusTipToRAS")
    )
    seen = stylus[1][[shown(stylus[0], time) for time in probe[0]]]
    turned = seen @ np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    devices = {"ProbeToRAS": probe[1], "StylusTipToRAS": seen, "StylusTipRotation": turned}
    return probe[0], devices, folder / "BodyModel.stl"


def slicer_matrix(path):
    """What 3D Slicer shows of a file of ITK, m: to the parent in RAS; ITK stores the inverse."""
    stored = sitk.ReadTransform(str(path)).GetInverse()
    matrix = np.eye(4)
    matrix[:3, 3] = stored.TransformPoint((0.0, 0.0, 0.0))
    matrix[:3, :3] = np.transpose([stored.TransformPoint(e) for e in np.eye(3)]) - matrix[:3, 3:]
    to_ras = np.diag([-1.0, -1.0, 1.0, 1.0])
    matrix = to_ras @ matrix @ to_ras
    matrix[:3, 3] /= MM
    return matrix


def in_plane(folder):
    scene = ElementTree.parse(folder / "Scene_InPlane.mrml").iter("Sequence")
    sequences = {node.get("name").removesuffix("-Sequence"): node for node in scene}
    devices = {"NeedleTipToNeedle": slicer_matrix(folder / "NeedleTipToNeedle.h5")}
    for name in ("NeedleToReference", "ImageToReference"):
        entries = sequences[name].get("indexValues").strip(";").split(";")
        times = np.array([float(entry.split(":")[1]) for entry in entries])
        with (
            zipfile.ZipFile(folder / f"{name}-Sequence.mrb") as bundle,
            tempfile.TemporaryDirectory() as unpacked,
        ):
            bundle.extractall(unpacked)
            files = [f"{name}_{n}" if n else name for n in range(len(entries))]
            data = Path(unpacked, f"{name}-Sequence", "Data")
            devices[name] = np.array([slicer_matrix(data / f"{n}.h5") for n in files])
    devices["NeedleTipToNeedle"] = devices["NeedleToReference"] @ devices["NeedleTipToNeedle"]
    return times, devices, folder / "TissueModel.stl"


def winding(points, triangles):
    """How often a surface goes round each point (van Oosterom and Strackee, 1983)."""
    a, b, c = (triangles[None, :, i] - points[:, None] for i in range(3))
    x, y, z = (np.linalg.norm(each, axis=-1) for each in (a, b, c))
    dot = lambda p, q: (p * q).sum(axis=-1)  # noqa: E731
    volume = dot(a, np.cross(b, c))
    return np.arctan2(volume, x * y * z + dot(a, b) * z + dot(b, c) * x + dot(c, a) * y).sum(
        axis=1
    ) / (2 * np.pi)


def tissue_metrics(moved, surface):
    mesh = read_with_meshio(surface, "no surface")
    triangles = mesh.points[mesh.cells_dict["triangle"]].astype(float) / MM
    inside = np.abs(winding(moved.positions, triangles)) > 0.5
    times, speeds = moved.steps[inside[1:]], moved.speeds[inside[1:]]
    return {
        "Path in Tissue": MM * speeds @ times,
        "Time in Tissue": times.sum(),
    }


@pytest.mark.slow
@pytest.mark.parametrize(("name", "read"), [("Lumbar", lumbar), ("InPlane", in_plane)])
def test_every_time_and_path_of_perk_tutors_tables(shared_data, name, read):
    folder = shared_data / "perktutor-truth" / name
    times, devices, surface = read(folder)
    with (folder / "TrueMetricsTable.tsv").open() as stream:
        rows = list(csv.DictReader(stream, delimiter="\t"))
    rows = [row for row in rows if row["MetricName"] != "Tissue Damage"]  # an area of a needle
    assert len(rows) == 8
    for row in rows:
        device = row["MetricRoles"].split(" = ")[1].split(",")[0]
        moved = motion(times, devices[device])
        own = table(moved)
        if row["MetricName"] not in own:
            own = tissue_metrics(moved, surface)
        assert own[row["MetricName"]] == pytest.approx(float(row["MetricValue"]), rel=1e-5), row


def test_the_angular_speed_is_that_of_the_shorter_turn():
    half = np.deg2rad(60.0 * 0.01 * np.arange(50)) / 2
    zero = 0 * half
    orientations = np.stack([zero, np.sin(half), zero, np.cos(half)], axis=1)
    orientations[::2] *= -1  # the same rotations
    moved = Motion(0.01 * np.arange(50), np.zeros((50, 3)), orientations)
    assert np.rad2deg(moved.angular_speeds) == pytest.approx(60.0)


@pytest.mark.parametrize(
    ("times", "positions", "orientations"),
    [
        ([0.0, 0.0], np.zeros((2, 3)), [[0, 0, 0, 1]] * 2),
        ([0.0, 1.0], np.zeros((3, 3)), [[0, 0, 0, 1]] * 2),
        ([0.0, 1.0], [[0, 0, 0], [0, np.nan, 0]], [[0, 0, 0, 1]] * 2),
    ],
)
def test_what_is_no_motion_is_refused(times, positions, orientations):
    with pytest.raises(ScoreError):
        Motion(times, positions, orientations)
