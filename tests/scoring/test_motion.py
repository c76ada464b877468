"""PerkTutor's published tables, met on its own recordings; movements whose metrics are known."""

import csv
import tempfile
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given
from hypothesis import strategies as st

from us_sim.errors import ScoreError
from us_sim.geometry.mesh_file import read_with_meshio
from us_sim.scoring.metrics import Scan, compute_metrics
from us_sim.scoring.motion import Motion

NEEDLE = 0.3  # m, TissueDamage.NEEDLE_LENGTH; it points along +z, as its evaluator has by default
MM, MM2 = 1e3, 1e6


def motion(times, matrices):
    """Of the positions; ITK's matrices of images are no rotations."""
    return Motion(times, matrices[:, :3, 3], np.tile([0, 0, 0, 1], (len(times), 1)))


def table(moved):
    return {metric.name: metric.value for metric in compute_metrics(Scan(moved))}


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


def first_hits(begins, ends, triangles):
    """Where each line first meets the surface (Möller and Trumbore); its end where it does not."""
    corner, e, f = triangles[:, 0], *(triangles[:, i] - triangles[:, 0] for i in (1, 2))
    found = ends.copy()
    for k, (begin, way) in enumerate(zip(begins, ends - begins, strict=True)):
        h, s = np.cross(way, f), begin - corner
        det, q = (e * h).sum(axis=1), np.cross(s, e)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, t = (s * h).sum(axis=1) / det, (q @ way) / det, (f * q).sum(axis=1) / det
        hit = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (t >= 0) & (t <= 1)
        found[k] = begin + way * min(t[hit], default=1.0)
    return found


def tissue_metrics(moved, matrices, surface):
    mesh = read_with_meshio(surface, "no surface")
    triangles = mesh.points[mesh.cells_dict["triangle"]].astype(float) / MM
    inside = np.abs(winding(moved.positions, triangles)) > 0.5
    base = moved.positions - NEEDLE * matrices[:, :3, 2]
    entry = first_hits(moved.positions, base, triangles)
    times, speeds = moved.steps[inside[1:]], moved.speeds[inside[1:]]
    return {
        "Tissue Damage": MM2 * moved.compute_swept_area(entry, inside),
        "Path in Tissue": MM * speeds @ times,
        "Time in Tissue": times.sum(),
    }


@pytest.mark.slow
@pytest.mark.parametrize(("name", "read"), [("Lumbar", lumbar), ("InPlane", in_plane)])
def test_every_value_of_perk_tutors_tables(shared_data, name, read):
    folder = shared_data / "perktutor-truth" / name
    times, devices, surface = read(folder)
    with (folder / "TrueMetricsTable.tsv").open() as stream:
        rows = list(csv.DictReader(stream, delimiter="\t"))
    assert len(rows) == 9
    for row in rows:
        device = row["MetricRoles"].split(" = ")[1].split(",")[0]
        moved = motion(times, devices[device])
        own = table(moved)
        if row["MetricName"] not in own:
            own = tissue_metrics(moved, devices[device], surface)
        assert own[row["MetricName"]] == pytest.approx(float(row["MetricValue"]), rel=1e-5), row


def minimum_jerk(length, seconds, count=2001):
    """Straight from rest to rest (Flash and Hogan, 1985)."""
    s = np.linspace(0, 1, count)
    x = length * (10 * s**3 - 15 * s**4 + 6 * s**5)
    return Motion(
        seconds * s, np.outer(x, [0.6, 0.0, 0.8]), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    )


@given(st.floats(0.01, 1.0), st.floats(0.2, 20.0))
def test_the_dimensionless_jerk_of_a_minimum_jerk_movement_is_720(length, seconds):
    moved = minimum_jerk(length, seconds)
    found = table(moved)
    assert found["Dimensionless Squared Jerk"] == pytest.approx(720, rel=0.01)
    squared_jerk = (1e-3 * found["Motion Smoothness"]) ** 2
    assert squared_jerk == pytest.approx(720 * length**2 / seconds**5, rel=0.01)
    assert moved.speeds.max() == pytest.approx(1.875 * length / seconds, rel=1e-4)
    peak = np.linalg.norm(moved.accelerations, axis=1).max()
    assert peak == pytest.approx(10 / 3**0.5 * length / seconds**2, rel=1e-3)


def test_an_action_is_faster_than_50_mm_s_and_ends_after_a_fifth_of_a_second():
    """Three bursts of 80 mm/s: the pause before the second is too short to end the first."""
    dt = 0.01
    fast = np.zeros(500, bool)
    fast[50:120] = fast[130:200] = fast[300:360] = True
    fast[400:415] = True  # too short to be one
    x = np.r_[0, np.cumsum(np.where(fast, 0.08, 0.04) * dt)]
    turn = np.r_[0, np.cumsum(np.where(fast, 60.0, 40.0) * dt)]
    half = np.deg2rad(turn) / 2
    zero = np.zeros_like(x)
    positions = np.stack([x, zero, zero], axis=1)
    orientations = np.stack([zero, np.sin(half), zero, np.cos(half)], axis=1)
    orientations[::2] *= -1  # the same rotations
    moved = Motion(dt * np.arange(501), positions, orientations)
    found = table(moved)
    assert found["Translational Actions"] == found["Rotational Actions"] == 2
    assert np.rad2deg(moved.angular_speeds[60]) == pytest.approx(60)


def test_a_line_that_moves_sideways_sweeps_a_rectangle():
    y = np.linspace(0, 0.03, 7)
    positions = np.stack([0 * y, y, 0 * y], axis=1)
    moved = Motion(np.arange(7.0), positions, np.tile([0, 0, 0, 1], (7, 1)))
    assert moved.compute_swept_area(np.add(positions, [0.04, 0, 0])) == pytest.approx(0.04 * 0.03)
    where = [True] * 3 + [False] * 4
    assert moved.compute_swept_area(np.add(positions, [0.04, 0, 0]), where) == pytest.approx(
        0.04 * 0.01
    )


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
