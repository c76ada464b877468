"""Where the image lies on the probe, from a file: Plus' configuration, or YAML.

Plus' XML may hold several transforms (``<Transform From="Image" To="Probe" Matrix=.../>``, mm),
and the part of an image that is tissue (``<VolumeReconstruction ClipRectangleOrigin=... />``).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError, VolumeError
from us_sim.settings.text_files import YamlError, load_yaml, read_bytes
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.transforms import frame_matrix, in_metres


@dataclass(frozen=True, eq=False)
class SweepCalibration:
    """The calibration of a sweep."""

    transforms: Mapping[str, NDArray[np.float64]]  # (4, 4) m (pixels of images), by name
    part: ImagePart  # of an image that is tissue


def read_calibration(path: Path, probe: str) -> SweepCalibration:
    """The fixed transforms of a sweep.

    Args:
        path: a configuration of Plus (.xml), or a matrix ``image_to_body`` (.yaml).
        probe: the frame of the tracked body that the image lies on, for the latter, which does
            not say its name.

    Raises:
        VolumeError: the file cannot be read, or holds no calibration.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be read: {error.strerror or error}") from error
    if path.suffix.lower() == ".xml":
        return _plus(path, data)
    return SweepCalibration({f"ImageTo{probe}": _image_to_body(path, data)}, ImagePart())


def _plus(path: Path, data: bytes) -> SweepCalibration:
    # Entities that expand without end are a known attack; no configuration needs any.
    if b"<!ENTITY" in data:
        raise VolumeError(f"{path}: defines entities, which is not allowed; remove them")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError) as error:
        raise VolumeError(f"{path}: is not XML: {error}") from error
    transforms = {}
    for element in root.iter("Transform"):
        start, end = element.get("From", ""), element.get("To", "")
        if not start or not end or element.get("Matrix") is None:
            continue
        name = f"{start[0].upper()}{start[1:]}To{end[0].upper()}{end[1:]}"
        try:
            matrix = frame_matrix({name: element.get("Matrix", "")}, name)
        except ValueError as reason:
            raise VolumeError(f"{path}: the transform {name} is {reason}; correct it") from reason
        transforms[name] = in_metres(name, matrix)
    if not transforms:
        raise VolumeError(
            f"{path}: holds no <Transform From=... To=... Matrix=...>; give a configuration of "
            f"Plus with the image's calibration"
        )
    return SweepCalibration(transforms, _part(path, root.find(".//VolumeReconstruction")))


def _part(path: Path, element: ElementTree.Element | None) -> ImagePart:
    said: dict[str, list[float]] = {}
    counts = {"ClipRectangleOrigin": 2, "ClipRectangleSize": 2, "FanOriginPixel": 2}
    counts |= {"FanAnglesDeg": 2, "FanRadiusStartPixel": 1, "FanRadiusStopPixel": 1}
    for key, count in counts.items():
        text = None if element is None else element.get(key)
        if text is None:
            continue
        try:
            said[key] = [float(word) for word in text.split()]
        except ValueError:
            said[key] = []
        if len(said[key]) != count:
            raise VolumeError(
                f"{path}: VolumeReconstruction: {key} is {text[:60]!r} where {count} number"
                f"{'s belong' if count > 1 else ' belongs'}; correct it"
            )
    given = {}
    size = said.get("ClipRectangleSize", [0.0])
    if min(size) > 0.0 and "ClipRectangleOrigin" in said:
        given["clip"] = [*said["ClipRectangleOrigin"], *size]
    angles = said.get("FanAnglesDeg", [0.0])
    if any(angles):  # Plus, too, takes two angles of 0 for no fan
        given["fan_angles"] = [f"{angle!r} deg" for angle in sorted(angles)]  # type: ignore[misc]
        given["fan_origin"] = said.get("FanOriginPixel", [0.0, 0.0])
        start, stop = said.get("FanRadiusStartPixel", [0.0]), said.get("FanRadiusStopPixel", [1e5])
        given["fan_radius"] = [*start, *stop]
    try:
        return ImagePart(**given)  # type: ignore[arg-type]
    except UsSimError as error:
        raise VolumeError(f"{path}: VolumeReconstruction: {error}") from error


def _image_to_body(path: Path, data: bytes) -> NDArray[np.float64]:
    """(4, 4) m, from (column, row, 0, 1)."""
    try:
        document = load_yaml(data.decode("utf-8"))
    except (UnicodeDecodeError, YamlError) as error:
        raise VolumeError(f"{path}: is neither XML nor YAML that can be read: {error}") from error
    rows = document.get("image_to_body") if isinstance(document, dict) else None
    try:
        text = " ".join(str(float(number)) for row in rows or () for number in row)
        return frame_matrix({"image_to_body": text}, "image_to_body")
    except (TypeError, ValueError) as error:
        raise VolumeError(
            f"{path}: holds no image_to_body, a 4 × 4 matrix from pixels to metres on the tracked "
            f"body"
        ) from error
