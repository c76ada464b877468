"""Plus' calibration of a probe by three N-wires as it is read, and a volume of such wires.

Plus found nine wires in each image. Of each N, the middle wire's point divides the line between
those of its parallel ones, which says where on the wire it lies (R. M. Comeau, A. Fenster and T. M.
Peters, Integrated MR and ultrasound imaging for improved image guidance in neurosurgery, Proc. SPIE
3338, 1998).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.study import Finding, Section, Study
from us_sim.evaluation.report import ReportFolder, filled, markdown_table, picture, plain
from us_sim.volume.files.readers import read_volume
from us_sim.volume.reconstruction.calibration_file import read_calibration
from us_sim.volume.reconstruction.reconstruction import plan, reconstruct
from us_sim.volume.reconstruction.settings import Compounding
from us_sim.volume.sequences.sequence import read_sequence
from us_sim.volume.sequences.sweep import sweep_of

Array = NDArray[np.float64]

_KEPT = 0.95  # part of the errors, the smallest, of which Plus takes the mean
_SPACING = 0.5e-3  # m, of Plus' volume
_SETUP = "PlusDeviceSet_fCal_Sim_SpatialCalibration_2.0.xml"
_RESULT = "FreehandCalibration3NWires_fCal2.0.results.xml"
_SWEEP_SETUP = "PlusDeviceSet_NwirePhantomFreehand_vtkVolumeReconstructorTest2.xml"
_RECORDINGS = {
    "calibration": "fCal_Test_Calibration_3NWires_fCal2.0.igs.mha",
    "validation": "fCal_Test_Validation_3NWires_fCal2.0.igs.mha",
}


@dataclass(frozen=True, eq=False)
class Recording:
    """The wires' points of a recording: F frames, nine wires, an N every three."""

    wires: Array  # (9, 2, 3) m, both ends in the phantom's frame
    pixels: Array  # (F, 9, 2), column and row
    poses: Array  # (F, 4, 4) m, of the probe's body in the phantom's frame

    def to_middles(self, image_to_body: Array) -> Array:
        """(F, 3) m from the middle wires' points to where the ratio says that they lie."""
        off = self._placed(image_to_body)[:, 1::3] - self.middles()
        return np.asarray(np.linalg.norm(off, axis=2))

    def middles(self) -> Array:
        """(F, 3, 3) m, in the phantom's frame, the point of each N's middle wire."""
        left, middle, right = (self.pixels[:, k::3] for k in range(3))
        ratio = np.linalg.norm(middle - left, axis=2) / np.linalg.norm(right - left, axis=2)
        ends = np.array(
            [[_meeting(n[1], n[side]) for side in (0, 2)] for n in self.wires.reshape(3, 3, 2, 3)]
        )
        return np.asarray(ends[:, 0] + ratio[..., None] * (ends[:, 1] - ends[:, 0]))

    def _placed(self, image_to_body: Array) -> Array:
        """(F, 9, 3) m, in the phantom's frame."""
        matrices = self.poses @ image_to_body
        return np.asarray(
            np.einsum("fij,fwj->fwi", matrices[:, :3, :2], self.pixels) + matrices[:, None, :3, 3]
        )


def _meeting(one: Array, other: Array) -> Array:
    """(3,) where two wires (2, 3) cross."""
    sides = np.stack([one[1] - one[0], other[0] - other[1]], axis=1)
    part = np.linalg.lstsq(sides, other[0] - one[0], rcond=None)[0][0]
    return np.asarray(one[0] + part * (one[1] - one[0]))


def plus_mean(errors: Array) -> float:
    """The mean of the smallest 95 % of errors, as Plus states its 3-D error."""
    return float(np.sort(errors, axis=None)[: round(_KEPT * errors.size)].mean())


def read_recording(folder: Path, which: str) -> Recording:
    """The ``calibration`` or the ``validation``; frames in which Plus found no wires are left out.

    Raises:
        UsSimError: a file is missing or cannot be read, or misses a wire.
    """
    setup, found = _xml(folder / _SETUP), _xml(folder / _RESULT)
    ends = ("EndPointFront", "EndPointBack")
    frames = found.findall(f".//{which.capitalize()}Data/Frame")
    try:
        wires = [[_numbers(wire.get(end, "")) for end in ends] for wire in setup.iter("Wire")]
        pixels = [
            [_numbers(point.get("Position", ""))[:2] for point in frame.iterfind(_POINTS)]
            for frame in frames
        ]
        used = [k for k, found_here in enumerate(pixels) if found_here]
        shaped = (
            np.array([pixels[k] for k in used]).reshape(-1, 9, 2),
            np.array(wires).reshape(9, 2, 3),
        )
    except ValueError as error:
        raise UsSimError(
            f"{folder}: {_SETUP} or {_RESULT} does not hold nine wires and a point of each in "
            f"every frame; fetch them again"
        ) from error
    fixed = read_calibration(folder / _SETUP, "Probe").transforms["PhantomToReference"]
    transforms = read_sequence(folder / _RECORDINGS[which]).transforms
    tracker = {name: transforms[f"{name}ToTracker"].matrices for name in ("Probe", "Reference")}
    if len(tracker["Probe"]) != len(frames):
        raise UsSimError(
            f"{folder}: {_RECORDINGS[which]} has {len(tracker['Probe'])} frames, where {_RESULT} "
            f"has points of {len(frames)}; fetch them again"
        )
    poses = np.linalg.inv(tracker["Reference"] @ fixed) @ tracker["Probe"]
    return Recording(1e-3 * shaped[1], shaped[0], poses[used])


_POINTS = "SegmentedPoints/Point"


def _xml(path: Path) -> ElementTree.Element:
    try:
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise UsSimError(f"{path}: cannot be read: {error}; fetch it again") from error


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def measure_nwires(folder: Path, report: ReportFolder) -> Section:
    """Take Plus' errors again, reconstruct from the recordings in ``folder``, and draw both.

    Raises:
        UsSimError: a file is missing or cannot be read.
    """
    recordings = {which: read_recording(folder, which) for which in _RECORDINGS}
    matrix = read_calibration(folder / _RESULT, "Probe").transforms["ImageToProbe"]
    said = _xml(folder / _RESULT).find(".//ReprojectionError3DStatistics")
    rows, findings = [], []
    for which, recording in recordings.items():
        stated = (
            float("nan") if said is None else float(said.get(f"{which.capitalize()}MeanMm", ""))
        )
        found = 1e3 * plus_mean(recording.to_middles(matrix))
        rows.append((which, f"{stated:.4f}", f"{found:.4f}"))
        findings.append(
            Finding("nwires", "matrix of Plus", f"3-D error, {which}", "mm",
                    stated, found, found - stated, headline=which == "validation")
        )  # fmt: skip
    volume = _volume(folder)
    findings += [
        Finding("nwires", "volume", "offset from that of Plus", "mm", error=volume.offset),
        Finding(
            "nwires",
            "volume",
            "correlation with that of Plus",
            "",
            1.0,
            volume.correlation,
            volume.correlation - 1.0,
        ),
    ]
    file = report.picture("nwires")
    _draw(file, recordings["validation"].to_middles(matrix), volume)
    text = filled(
        "measured",
        "nwires",
        table=markdown_table(["recording", "stated by Plus", "found"], rows),
        volume=volume.words(),
        picture=file.name,
    )
    return Section("N-wires and Plus", text, findings)


@dataclass(frozen=True, eq=False)
class _Volumes:
    """The project's volume and that of Plus, in the voxels that both have."""

    ours: Array  # (i, j, k)
    plus: Array
    shapes: Sequence[tuple[int, ...]]
    seconds: float  # of processor time, with reading

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which voxels are not black in both."""
        return np.asarray((self.ours > 0) | (self.plus > 0))

    @property
    def correlation(self) -> float:
        """Over the voxels that are not black in both."""
        return float(np.corrcoef(self.ours[self.seen], self.plus[self.seen])[0, 1])

    @property
    def offset(self) -> float:
        """mm by which one is shifted against the other, by least squares."""
        slopes = np.stack([slope.ravel() for slope in np.gradient(self.ours)], axis=1)
        shift = np.linalg.lstsq(slopes, (self.ours - self.plus).ravel(), rcond=None)[0]
        return 1e3 * _SPACING * float(np.linalg.norm(shift))

    def words(self) -> str:
        """For the report."""
        sizes = " and ".join(" × ".join(map(str, shape)) for shape in self.shapes)
        levels = np.abs(self.ours - self.plus)[self.seen].mean()
        return (
            f"Grids of {sizes} voxels of {1e3 * _SPACING:g} mm begin at the same place; the "
            f"volumes are shifted against each other by {self.offset:.4f} mm. Over the voxels that "
            f"are not black in both, {self.seen.sum():,} of {self.seen.size:,}, they correlate by "
            f"{self.correlation:.4f} and differ by {levels:.1f} of 255 levels: Plus rounds its "
            f"running mean after every pixel, the project once. Reading and "
            f"reconstructing took {self.seconds:.1f} s of processor time."
        )


def _volume(folder: Path) -> _Volumes:
    theirs = read_volume(folder / "NwirePhantomFreehandReconstructed.mha").intensities
    begun = time.process_time()
    setup = read_calibration(folder / _SWEEP_SETUP, "Probe")
    sequence = read_sequence(folder / "NwirePhantomFreehand.igs.mha")
    sweep = sweep_of(sequence, calibration=setup.transforms)

    settings = Compounding(spacing=_SPACING, hole_radius=0.0)
    ours = reconstruct(plan(sweep, settings, setup.part)).volume.intensities
    seconds = time.process_time() - begun
    common = tuple(slice(min(pair)) for pair in zip(ours.shape, theirs.shape, strict=True))
    grey, plus = (np.asarray(each[common], np.float64) for each in (ours, theirs))
    return _Volumes(grey, plus, (ours.shape, theirs.shape), seconds)


def _draw(file: Path, errors: Array, volumes: _Volumes) -> None:
    with picture(
        file,
        11.0,
        3.6,
        "N-wires: errors of Plus' matrix on the validation recording; volumes, brightest voxels",
    ) as f:
        axes, ours, plus = f.subplots(1, 3)
        axes.plot(1e3 * np.sort(errors, axis=None), np.linspace(0, 100, errors.size))
        axes.set(xlabel="3-D error, mm", ylabel="% of the middle wires' points", xlim=(0, 2))
        plain(axes)
        for panel, grey, title in (
            (ours, volumes.ours, "the project's volume"),
            (plus, volumes.plus, "Plus' volume"),
        ):
            panel.imshow(grey.max(axis=2).T, cmap="gray", vmin=0, vmax=255)
            panel.set_title(f"{title}, seen along z", fontsize=10)
            panel.axis("off")


STUDY = Study(
    name="nwires",
    folder="plus-nwire-calibration",
    address="https://github.com/PlusToolkit/PlusLibData, revision "
    "51dcbb76d9f29fad94cf80788a7a0b7c704fb5dc",
    licence="BSD-style",
    citation="A. Lasso et al., PLUS: Open-Source Toolkit for Ultrasound-Guided Intervention "
    "Systems, IEEE Trans. Biomed. Eng. 61, 2014.",
    measure=measure_nwires,
)
