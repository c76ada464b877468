"""Reconstruction for `us-sim reconstruct`: from a file of a sweep to a volume or a case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from us_sim import Progress
from us_sim.command.volume_pictures import draw_slices
from us_sim.errors import VolumeError
from us_sim.settings.setting import Settings, setting
from us_sim.volume.cases.proposal import move_to_skin
from us_sim.volume.cases.settings import CaseSettings
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.writing import VOLUME_ENDINGS, explain_volume_ending, write_volume
from us_sim.volume.reconstruction.calibration_file import SweepCalibration, read_calibration
from us_sim.volume.reconstruction.reconstruction import Rest, plan_insertion, reconstruct
from us_sim.volume.reconstruction.scanning_probe import find_scanning_probe
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sweep import TrackedSweep, read_sweep


@dataclass(frozen=True)
class SweepSettings(Settings):
    """The sweep, the place of the result, and the placement of the images."""

    error = VolumeError

    sweep: Path = setting(description="tracked images: .igs.mha, .mha, .igs.nrrd or .seq.nrrd")
    out: Path = setting(
        description="file that ends in .nrrd, .mha, .nii or .nii.gz, or else folder of a new case",
        kw_only=True,
    )
    calibration: Path | None = setting(
        description="where the image lies on the probe: Plus' XML, or YAML with image_to_body",
        default=None,
    )
    image: str = setting(description="name of the images' frame", default="Image")
    probe: str = setting(description="name of the tracked body's frame", default="Probe")
    reference: str = setting(description="name of the frame to reconstruct in", default="Reference")

    def check(self) -> None:
        """Refuse a place that exists or cannot be written, before the work."""
        for path in (self.out, self.picture):
            if path.exists():
                raise self.make_error("out", f"{path}: exists already; choose another name")
        if problem := explain_volume_ending(self.out):
            raise self.make_error("out", problem)
        if self.is_volume and not self.out.absolute().parent.is_dir():
            raise self.make_error("out", f"{self.out}: there is no {self.out.absolute().parent}")

    @property
    def is_volume(self) -> bool:
        """True to write a volume's file, and not a case."""
        return self.out.name.lower().endswith(VOLUME_ENDINGS)

    @property
    def picture(self) -> Path:
        """The file of the picture, beside the volume or in the case."""
        if not self.is_volume:
            return self.out / "volume.png"
        ending = next(end for end in VOLUME_ENDINGS if self.out.name.lower().endswith(end))
        return self.out.with_name(f"{self.out.name[: -len(ending)]}.png")


def reconstruct_sweep(
    settings: SweepSettings,
    compounding: Compounding,
    part: ImagePart,
    *,
    rest_of: Callable[[TrackedSweep, ImagePart], Rest] | None = None,
    progress: Progress | None = None,
) -> str:
    """Reconstruct a sweep and write the result; return a sentence about it.

    Args:
        settings: the sweep, and the place of the result.
        compounding: method of compounding.
        part: of each image; the default takes the calibration's.
        rest_of: makes, from the placed sweep, the function that undoes the tissue's deformation.
        progress: called with the fraction done, and words on the work.

    Raises:
        UsSimError: the files cannot be read, or do not make a volume.
    """
    calibration = SweepCalibration({}, ImagePart())
    if settings.calibration is not None:
        calibration = read_calibration(settings.calibration, settings.probe)
    part = part if part != ImagePart() else calibration.part
    sweep = read_sweep(
        settings.sweep,
        image=settings.image,
        reference=settings.reference,
        calibration=calibration.transforms,
    )
    rest = None if rest_of is None else rest_of(sweep, part)
    planned = plan_insertion(sweep, compounding, part, rest)
    made = reconstruct(planned, progress=progress)
    scanner = None if settings.is_volume else find_scanning_probe(sweep, part, planned.used)
    shape = " × ".join(map(str, made.volume.shape))
    size = f"{shape} voxels of {1e3 * planned.grid.spacing:.4g} mm"
    picture = settings.picture
    if scanner is None:
        write_volume(settings.out, made.volume)
        draw_slices(picture, made.volume, made.covered, size)
    else:
        with new_case(settings.out) as folder:
            write_volume(folder / "volume.nrrd", made.volume)
            scanned = scanner.poses
            if planned.rest:  # what they pressed lies at rest
                scanned = tuple(move_to_skin(each, made.volume, scanner.probe) for each in scanned)
            case = CaseSettings(name=settings.out.name, probe=scanner.probe, scanned=scanned)
            write_case_settings(folder, case)
            draw_slices(folder / picture.name, made.volume, made.covered, size)
    sentences = [
        f"{settings.out}: {size} ({100.0 * made.covered.mean():.0f} % covered, {made.filled} of "
        f"them filled holes) from {len(sweep.numbers)} frames"
    ]
    if left_out := sweep.left_out:
        why = ", ".join(f"{number} with {reason}" for reason, number in left_out.items())
        sentences.append(f"left out are {why}")
    steps = np.linalg.norm(sweep.image_to_reference[:, :3, :2], axis=1)
    if np.abs(steps - 1e-3).max() < 1e-9:
        sentences.append(
            "its pixels are 1 mm, as of an image that nobody calibrated: then give --calibration"
        )
    if sweep.sequence.are_colours:
        sentences.append("its colour images were made grey")
    if scanner is not None:
        probe = scanner.probe and f"those of a {scanner.probe.geometry} array"
        sentences.append(f"its images are {probe or 'of a probe whose shape is guessed'}")
    return "; ".join([*sentences, f"slices in {picture}"])
