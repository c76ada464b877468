"""Labels from files of other programs, on the grid of the volume that they belong to.

Any MHA, NRRD or NIfTI file will do, whose values are then labels; 3D Slicer's ``.seg.nrrd`` with
the names and colours of its segments.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.settings.spelling import format_count, short_repr
from us_sim.volume.files.readers import open_image
from us_sim.volume.files.stored_image import StoredImage
from us_sim.volume.structure_names import Colour, is_anatomical, make_readable
from us_sim.volume.volume import LabelMap, Volume

_MOST = 255
_FIELD = re.compile(r"Segment(\d{1,6})_(\w+)")
_Known = dict[int, tuple[str, Colour | None]]


@dataclass(frozen=True)
class Segment:
    """One segment of a file."""

    name: str
    value: int  # of its voxels
    layer: int
    colour: Colour | None  # red, green, blue, 0 to 1


def parse_segments(path: Path, pairs: Mapping[str, str]) -> list[Segment]:
    """Return the segments that a header's keys and values describe, in their order; often none.

    Several segments share a layer as long as they do not overlap; in a layer each has a number.
    Files of Slicer before 5 have a layer for each segment, in which it is 1
    (slicer.readthedocs.io, "Segmentations", "Segmentation file (.seg.nrrd) file format").
    """
    for key in ("Segmentation_MasterRepresentation", "Segmentation_SourceRepresentation"):
        if (said := pairs.get(key, "Binary labelmap")).lower() != "binary labelmap":
            raise VolumeError(
                f"{path}: holds segments as {short_repr(said)}; save it with `Binary labelmap` as "
                f"the source representation"
            )
    found: dict[int, dict[str, str]] = {}
    for key, value in pairs.items():
        if match := _FIELD.fullmatch(key):
            found.setdefault(int(match[1]), {})[match[2]] = value
    shared = any("LabelValue" in fields for fields in found.values())
    segments = []
    for at, (number, fields) in enumerate(sorted(found.items())):
        value = fields.get("LabelValue", "1")
        layer = fields.get("Layer", "0" if shared else f"{at}")
        if not (value.isdecimal() and int(value) and layer.isdecimal()):
            raise VolumeError(
                f"{path}: its Segment{number} has the LabelValue {short_repr(value)} and the Layer "
                f"{short_repr(layer)}, where numbers belong, from 1 and 0 on; save it again"
            )
        segments.append(
            Segment(
                fields.get("Name", "").strip() or f"structure {number + 1}",
                int(value),
                int(layer),
                _colour(fields.get("Color", "")),
            )
        )
    return segments


def refuse_segments(path: Path, pairs: Mapping[str, str]) -> None:
    """Refuse a segmentation, by the keys of its header, where an image belongs."""
    if any(map(_FIELD.fullmatch, pairs)):
        raise VolumeError(
            f"{path}: is a segmentation, which has labels and no grey values; give it to "
            f"`us-sim segment CASE --labels {path.name}`"
        )


def _colour(text: str) -> Colour | None:
    """Read a colour; where it is none, the structure's name suggests one."""
    try:
        red, green, blue = (float(word) for word in text.split())
    except ValueError:
        return None
    return (red, green, blue) if all(0.0 <= part <= 1.0 for part in (red, green, blue)) else None


def read_labels(
    path: str | os.PathLike[str],
    like: Volume,
    *,
    names: Mapping[int, str] | None = None,
    taken: Collection[str] = (),
) -> LabelMap:
    """Read the labels in a file, on the grid of a volume.

    Of names that come from the file only those are kept that are made of anatomical
    words, since some hold a patient's; another structure is called by its number. Where segments
    overlap, a voxel is of the one that comes last, as when 3D Slicer exports a label map.

    Args:
        path: MHA, NRRD, NIfTI, or a segmentation of 3D Slicer.
        like: the volume that they belong to.
        names: by label, as a person gives them; they go before all others.
        taken: names that mean something else; a structure of that name gets a number.

    Raises:
        VolumeError: a file cannot be read, its values are no labels, or no voxel of it has one.
    """
    path = Path(path)
    remarks: list[str] = []
    image = open_image(path, layers=True)
    segments, layers = parse_segments(path, image.texts), _layers(path, image)
    if segments:
        labels, known = _from_segments(path, layers, segments, remarks)
    else:
        labels, known = _from_values(path, layers, remarks)
    labels, moved = resample_labels(
        path, labels, image.placement(), like.shape, like.index_to_patient
    )
    there = {int(label) for label in _values_in(labels)} - {0}
    gone = [_plain(known[label][0], label) for label in known if label not in there]
    if gone:
        remarks.append(f"{', '.join(gone)}: no voxel of the volume has it; it is left out")
    if not there:
        raise VolumeError(f"{path}: none of its voxels has a label: segment it first")
    kept, said = _names({label: known[label][0] for label in sorted(there)}, names or {}, taken)
    colours = {label: colour for label, (_, colour) in known.items() if colour is not None}
    return LabelMap(labels, kept, colours, (*moved, *remarks, *said))


def _layers(path: Path, image: StoredImage) -> NDArray[np.generic]:
    """Read stored values (layer, i, j, k), whole numbers from 0 on."""
    if image.volumes > 1:
        raise VolumeError(f"{path}: holds {image.volumes} volumes; give one of labels")
    stored = image.read()
    layers = stored if image.components > 1 else stored[None]
    is_whole = layers.dtype.kind != "f" or bool((layers == np.rint(layers)).all())
    if not is_whole or not (least := layers.min()) >= 0:
        has = f"go down to {least:g}" if is_whole else "have fractions"
        raise VolumeError(f"{path}: its values {has}; labels are whole numbers from 0 on")
    return layers


def _from_segments(
    path: Path, layers: NDArray[np.generic], segments: list[Segment], remarks: list[str]
) -> tuple[NDArray[np.uint8], _Known]:
    """Return labels (i, j, k), names and colours of segments in their layers."""
    deepest = max(segment.layer for segment in segments)
    if deepest >= len(layers):
        raise VolumeError(f"{path}: says that a segment is in layer {deepest} of {len(layers)}")
    if len(segments) > _MOST:
        raise VolumeError(f"{path}: has {len(segments)} segments; {_MOST} are read at most")
    values = [segment.value for segment in segments]
    keep = len(set(values)) == len(values) and min(values) > 0 and max(values) <= _MOST
    labels = np.zeros(layers.shape[1:], np.uint8)
    known: _Known = {}
    overlap = 0
    for number, segment in enumerate(segments, start=1):
        label = segment.value if keep else number
        known[label] = (segment.name, segment.colour)
        inside = np.asarray(layers[segment.layer] == segment.value)
        overlap += int(np.count_nonzero(labels[inside]))
        labels[inside] = label
    if overlap:
        remarks.append(
            f"segments overlap in {format_count(overlap, 'voxel')}, now of the later one"
        )
    return labels, known


def _from_values(
    path: Path, layers: NDArray[np.generic], remarks: list[str]
) -> tuple[NDArray[np.uint8], _Known]:
    """Return labels (i, j, k) of a file without segments, whose values they are."""
    stored = layers[0]
    values = _values_in(stored)
    values = values[values != 0]  # and none is below
    if len(layers) > 1 or len(values) > _MOST:
        raise VolumeError(
            f"{path}: holds {len(values)} different values and "
            f"{format_count(len(layers), 'number')} per voxel, so it is no label image; labels are "
            f"one, and {_MOST} at most"
        )
    labels = stored
    if len(values) and values[-1] > _MOST:
        labels = np.searchsorted(values, stored, "right")
        remarks.append(
            f"labels up to {values[-1]:g} were numbered anew from 1 to {len(values)}, in order"
        )
        values = np.arange(1, len(values) + 1)
    known: _Known = {int(value): (f"structure {int(value)}", None) for value in values}
    return np.ascontiguousarray(labels).astype(np.uint8), known


def _values_in(stored: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return the values that occur, in order; slab by slab, since sorting takes memory."""
    return np.asarray(np.unique(np.concatenate([np.unique(slab) for slab in stored])))


def _plain(name: str, label: int) -> str:
    """Return a name that may be said and kept."""
    return make_readable(name).lower() if is_anatomical(name) else f"structure {label}"


def _names(
    found: Mapping[int, str], given: Mapping[int, str], reserved: Collection[str]
) -> tuple[dict[int, str], list[str]]:
    """Return names that are kept, each once, and remarks about the others."""
    names: dict[int, str] = {}
    said: list[str] = []
    hidden = [n for n, name in found.items() if n not in given and not is_anatomical(name)]
    taken = {*reserved, *given.values()}
    for label, name in found.items():
        wanted = given.get(label) or _plain(name, label)
        numbered = (f"{wanted} {number}" for number in itertools.count(2))
        free = (each for each in itertools.chain([wanted], numbered) if each not in taken)
        names[label] = given.get(label) or next(free)
        taken.add(names[label])
        if wanted in reserved and names[label] != wanted:
            said.append(f"{wanted} means something else in a case, so it is called {names[label]}")
    if hidden:
        numbers = ", ".join(map(str, hidden))
        said.append(
            f"the names of labels {numbers} are not kept, as they are no anatomical terms: give "
            f"them with --names {hidden[0]}=NAME"
        )
    return names, said


def resample_labels(
    path: Path,
    labels: NDArray[np.uint8],
    placement: NDArray[np.float64],
    shape: tuple[int, int, int],
    wanted: NDArray[np.float64],
) -> tuple[NDArray[np.uint8], list[str]]:
    """Put labels of a file on a grid of that shape, and remark on it for a person.

    A file may hold only the part of a volume that is labelled, or its axes in another order or
    direction; its voxels are then those of the volume. Of other grids the nearest voxel is taken.
    Both places are (4, 4) m, from the indices of the file and of the grid that is ``wanted``.
    """
    to_grid = np.linalg.inv(wanted) @ placement
    whole = np.rint(to_grid)
    # Single precision, which NIfTI has, makes equal grids differ by less than 0.02 voxels.
    off = np.abs(to_grid - whole) @ [*labels.shape, 1.0]
    is_turn = all((np.abs(whole[:3, :3]).sum(axis=axis) == 1.0).all() for axis in (0, 1))
    is_same = is_turn and off.max() <= 0.02
    made = labels
    if not is_same or labels.shape != shape or not np.array_equal(whole, np.eye(4)):
        to_file = np.rint(np.linalg.inv(whole)) if is_same else np.linalg.inv(to_grid)
        made = ndimage.affine_transform(labels, to_file, output_shape=shape, order=0)
    before, after = np.count_nonzero(labels), np.count_nonzero(made)
    if before and not after:
        raise VolumeError(
            f"{path}: its labels lie wholly outside the volume: they belong to another one, or "
            f"their axes were taken for others (left-posterior-superior is meant)"
        )
    if not is_same:
        sizes = _describe_grid(labels.shape, placement), _describe_grid(shape, wanted)
        return made, [f"labels of {sizes[0]} were resampled to {sizes[1]} by the nearest voxel"]
    lost = f"{before - after} of {before} labelled voxels lie outside the volume and are left out"
    return made, [lost] if before > after else []


def _describe_grid(shape: tuple[int, ...], placement: NDArray[np.float64]) -> str:
    sides = np.linalg.norm(placement[:3, :3], axis=0) * 1e3
    return (
        f"{' × '.join(map(str, shape))} voxels of {' × '.join(f'{side:.3g}' for side in sides)} mm"
    )
