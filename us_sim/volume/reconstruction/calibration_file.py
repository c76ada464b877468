"""The place of the image on the probe, from a file: Plus' configuration, or YAML.

Plus' XML may hold several transforms (``<Transform From="Image" To="Probe" Matrix=.../>``, mm),
and the part of an image that is tissue (``<VolumeReconstruction ClipRectangleOrigin=... />``).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError, VolumeError
from us_sim.settings.text_files import read_yaml
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.transforms import parse_frame_matrix, to_metres


@dataclass(frozen=True, eq=False)
class SweepCalibration:
    """The calibration of a sweep."""

    transforms: Mapping[str, NDArray[np.float64]]  # (4, 4) m (pixels of images), by name
    part: ImagePart  # of an image that is tissue


def read_calibration(path: Path, probe: str) -> SweepCalibration:
    """Read the fixed transforms of a sweep: a configuration of Plus, or ``image_to_body`` in YAML.

    YAML does not name the frame of the tracked body that the image lies on: it is ``probe``.

    Raises:
        VolumeError: the file cannot be read, or holds no calibration.
    """
    if path.suffix.lower() == ".xml":
        return _read_plus_configuration(path)
    try:
        rows = read_yaml(path, VolumeError)["image_to_body"]
        text = " ".join(str(float(number)) for row in rows for number in row)
        matrix = parse_frame_matrix({"image_to_body": text}, "image_to_body")
    except (LookupError, TypeError, ValueError) as error:
        raise VolumeError(
            f"{path}: holds no image_to_body, a 4 × 4 matrix from pixels to metres on the tracked "
            f"body"
        ) from error
    return SweepCalibration({f"ImageTo{probe}": matrix}, ImagePart())


def _read_plus_configuration(path: Path) -> SweepCalibration:
    """Read the transforms, and the part of the image that is tissue."""
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise VolumeError(f"{path}: cannot be read as XML: {error}") from error
    transforms = {}
    for element in root.iter("Transform"):
        start, end = element.get("From", ""), element.get("To", "")
        if not start or not end or element.get("Matrix") is None:
            continue
        name = f"{start[0].upper()}{start[1:]}To{end[0].upper()}{end[1:]}"
        try:
            matrix = parse_frame_matrix({name: element.get("Matrix", "")}, name)
        except ValueError as reason:
            raise VolumeError(f"{path}: the transform {name} is {reason}; correct it") from reason
        transforms[name] = to_metres(name, matrix)
    if not transforms:
        raise VolumeError(
            f"{path}: holds no <Transform From=... To=... Matrix=...>; give a configuration of "
            f"Plus with the image's calibration"
        )
    return SweepCalibration(transforms, _part(path, root.find(".//VolumeReconstruction")))


def _part(path: Path, element: ElementTree.Element | None) -> ImagePart:
    """Return the clip rectangle and the fan of a ``<VolumeReconstruction>``."""
    if element is None:
        return ImagePart()
    given: dict[str, Any] = {}
    try:
        said = {
            key: [float(word) for word in text.split()]
            for key, text in element.items()
            if key.startswith(("Clip", "Fan"))
        }
        size = said.get("ClipRectangleSize", [0.0])
        if min(size) > 0.0 and "ClipRectangleOrigin" in said:
            given["clip"] = [*said["ClipRectangleOrigin"], *size]
        angles = said.get("FanAnglesDeg", [0.0])
        if any(angles):  # Plus, too, takes two angles of 0 for no fan
            given["fan_angles"] = [f"{angle!r} deg" for angle in sorted(angles)]
            given["fan_origin"] = said.get("FanOriginPixel", [0.0, 0.0])
            begins = said.get("FanRadiusStartPixel", [0.0])
            given["fan_radius"] = [*begins, *said.get("FanRadiusStopPixel", [1e5])]
        return ImagePart(**given)
    except (ValueError, UsSimError) as error:
        key = f"{error.key}: " if isinstance(error, UsSimError) and error.key else ""
        raise VolumeError(f"{path}: VolumeReconstruction: {key}{error}") from error
