"""Labels from files of other programs, on the grid of the volume that they belong to.

Any MHA, NRRD or NIfTI file will do, whose values are then labels; 3D Slicer's ``.seg.nrrd`` and
DICOM segmentations with the names and colours of their segments; and a table of labels beside
either.

>>> import pathlib, tempfile
>>> import numpy as np
>>> from us_sim.volume.files.labels import read_labels
>>> from us_sim.volume.files.writing import write_labels
>>> from us_sim.volume.volume import Volume
>>> labels = np.zeros((6, 5, 4), np.uint8)
>>> labels[2:4, 2:4, 1:3] = 5
>>> volume = Volume(np.zeros_like(labels), np.diag([1e-3, 1e-3, 1e-3, 1.0]), labels, {5: "artery"})
>>> with tempfile.TemporaryDirectory() as folder:
...     write_labels(pathlib.Path(folder, "labels.seg.nrrd"), volume)
...     read = read_labels(pathlib.Path(folder, "labels.seg.nrrd"), volume)
>>> read.names, read.voxels
({5: 'artery'}, {'artery': 8})
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.anatomical_colours import Colour
from us_sim.volume.files.dicom.header import is_dicom, open_dicom
from us_sim.volume.files.label_grid import on_grid
from us_sim.volume.files.label_table import read_label_table
from us_sim.volume.files.readers import ENDINGS, open_image
from us_sim.volume.files.segments import Segment, check_representation, segments_of
from us_sim.volume.files.stored_image import StoredImage
from us_sim.volume.label_map import LabelMap
from us_sim.volume.structure_terms import coded_name, is_anatomical, readable
from us_sim.volume.volume import Volume

_MOST = 255


def read_labels(
    path: str | os.PathLike[str],
    like: Volume,
    *,
    resample: bool = False,
    table: str | os.PathLike[str] | None = None,
    names: Mapping[int, str] | None = None,
    taken: Collection[str] = (),
) -> LabelMap:
    """The labels in a file, on the grid of a volume.

    Of names that come from the file, or a table, only those are kept that are made of anatomical
    words, since some hold a patient's; another structure is called by its number. Where segments
    overlap, a voxel is of the one that comes last, as when 3D Slicer exports a label map.

    Args:
        path: MHA, NRRD, NIfTI, a segmentation of 3D Slicer or of DICOM.
        like: the volume that they belong to.
        resample: take the nearest voxel where the file's grid is another than the volume's.
        table: names and colours, see `read_label_table`.
        names: by label, as a person gives them; they go before all others.
        taken: names that mean something else; a structure of that name gets a number.

    Raises:
        VolumeError: a file cannot be read, its values are no labels, no voxel of it has one, or its
            grid is another one and ``resample`` is not given.
    """
    path = Path(path)
    remarks: list[str] = []
    try:
        labels, known, placement = _read(path, remarks)
        labels, moved = on_grid(
            labels, placement, like.shape, like.index_to_patient, resample=resample
        )
    except VolumeError as error:
        raise (
            error if str(error).startswith(str(path)) else VolumeError(f"{path}: {error}")
        ) from error
    listed = {} if table is None else read_label_table(Path(table))
    known |= {label: entry for label, entry in listed.items() if label in known}
    there = {int(label) for label in _values_in(labels)} - {0}
    gone = [_plain(known[label][0], label) for label in known if label not in there]
    if gone:
        remarks.append(f"{', '.join(gone)}: no voxel of the volume has it; it is left out")
    if not there:
        raise VolumeError(f"{path}: none of its voxels has a label: segment it first")
    kept, said = _names({label: known[label][0] for label in sorted(there)}, names or {}, taken)
    colours = {label: colour for label, (_, colour) in known.items() if colour is not None}
    return LabelMap(labels, kept, colours, (*moved, *remarks, *said))


_Known = dict[int, tuple[str, Colour | None]]


def _read(path: Path, remarks: list[str]) -> tuple[NDArray[np.uint8], _Known, NDArray[np.float64]]:
    """Labels (i, j, k) on the file's grid, their names and colours, and its placement."""
    if not path.name.lower().endswith(ENDINGS) and path.is_file() and is_dicom(path):
        from us_sim.volume.files.dicom.segmentation import read_segmentation

        found = read_segmentation(open_dicom(path))
        made = _from_segments(found.shape, found.segments, found.mask, remarks)
        return *made, found.placement
    image = open_image(path, layers=True)
    placement = image.placement()
    check_representation(image.texts)
    layers, segments = _layers(image), segments_of(image.texts)
    if not segments:
        return *_from_values(layers, remarks), placement

    def mask(segment: Segment) -> NDArray[np.bool_]:
        if segment.layer >= len(layers):
            raise VolumeError(
                f"says that a segment is in layer {segment.layer} of {len(layers)}; save it again"
            )
        inside = layers[segment.layer] == segment.value
        return inside if segment.extent is None else _within(inside, segment.extent)

    return *_from_segments(image.shape, segments, mask, remarks), placement


def _layers(image: StoredImage) -> NDArray[np.generic]:
    """Stored values (layer, i, j, k), whole numbers from 0 on."""
    if image.volumes > 1:
        raise VolumeError(f"holds {image.volumes} volumes; give one of labels")
    stored = np.stack(list(image.slices()))
    layers = (stored if image.components > 1 else stored[..., None]).transpose(3, 2, 1, 0)
    if layers.dtype.kind == "f":
        for layer in layers:
            if not (np.isfinite(layer).all() and (layer == np.rint(layer)).all()):
                raise VolumeError(
                    "its values are no labels but numbers with fractions; give a label image"
                )
    if layers.min() < 0:
        raise VolumeError(f"its values go down to {layers.min():g}; labels are 0 or more")
    return layers


def _from_segments(
    shape: tuple[int, ...],
    segments: list[Segment],
    mask: Callable[[Segment], NDArray[np.bool_]],
    remarks: list[str],
) -> tuple[NDArray[np.uint8], _Known]:
    """Labels (i, j, k), names and colours of segments, of which each has a mask (i, j, k)."""
    if len(segments) > _MOST:
        raise VolumeError(f"has {len(segments)} segments; {_MOST} are read at most")
    values = [segment.value for segment in segments]
    keep = len(set(values)) == len(values) and min(values) > 0 and max(values) <= _MOST
    labels = np.zeros(shape, np.uint8)
    known: _Known = {}
    for number, segment in enumerate(segments, start=1):
        label = segment.value if keep else number
        name = segment.name if is_anatomical(segment.name) else coded_name(segment.codes)
        known[label] = (name or segment.name, segment.colour)
        inside = mask(segment)
        for other in np.unique(labels[inside]):
            if other:
                both = int(np.count_nonzero(labels[inside] == other))
                one, two = _plain(known[int(other)][0], int(other)), _plain(known[label][0], label)
                remarks.append(
                    f"{one} and {two} overlap in {both} voxel{'s' * (both > 1)}, now of {two}"
                )
        labels[inside] = label
    return labels, known


def _within(mask: NDArray[np.bool_], extent: tuple[int, ...]) -> NDArray[np.bool_]:
    """What of a mask lies within first and last indices, where 3D Slicer looks for a segment."""
    inside = np.zeros_like(mask)
    spans = tuple(
        slice(max(extent[2 * axis], 0), max(extent[2 * axis + 1] + 1, 0)) for axis in range(3)
    )
    inside[spans] = mask[spans]
    return inside


def _from_values(
    layers: NDArray[np.generic], remarks: list[str]
) -> tuple[NDArray[np.uint8], _Known]:
    """Labels (i, j, k) of a file without segments, whose values they are."""
    if len(layers) > 1:
        raise VolumeError(f"holds {len(layers)} numbers per voxel; labels are one")
    stored = layers[0]
    values = _values_in(stored)
    values = values[values != 0]  # and none is below
    if len(values) > _MOST:
        raise VolumeError(
            f"holds {len(values)} different values, so it is no label image; labels are {_MOST} at "
            f"most"
        )
    if len(values) and values[-1] > _MOST:
        labels = np.zeros(stored.shape, np.uint8)
        for label, value in enumerate(values, start=1):
            labels[stored == value] = label
        remarks.append(
            f"labels up to {values[-1]:g} were numbered anew from 1 to {len(values)}, in order"
        )
        values = np.arange(1, len(values) + 1)
    else:
        labels = np.ascontiguousarray(stored).astype(np.uint8)
    return labels, {int(value): (f"structure {int(value)}", None) for value in values}


def _values_in(stored: NDArray[np.generic]) -> NDArray[np.generic]:
    """Which values occur, in order; slab by slab, since sorting takes memory."""
    values = np.unique(np.concatenate([np.unique(slab) for slab in stored]))
    return np.asarray(values)


def _plain(name: str, label: int) -> str:
    """A name that may be said and kept."""
    return readable(name).lower() if is_anatomical(name) else f"structure {label}"


def _names(
    found: Mapping[int, str], given: Mapping[int, str], reserved: Collection[str]
) -> tuple[dict[int, str], list[str]]:
    """Names that are kept, each once, and what is said of the others."""
    names: dict[int, str] = {}
    said: list[str] = []
    hidden = [n for n, name in found.items() if n not in given and not is_anatomical(name)]
    for label, name in found.items():
        wanted = given.get(label) or _plain(name, label)
        taken, number = set(names.values()) | set(given.values()) - {given.get(label)}, 2
        taken |= set() if label in given else set(reserved)
        unique = wanted
        while unique in taken:
            unique, number = f"{wanted} {number}", number + 1
        names[label] = unique
        if wanted in reserved and unique != wanted:
            said.append(f"{wanted} means something else in a case, so it is called {unique}")
    if hidden:
        numbers = ", ".join(map(str, hidden))
        said.append(
            f"the names of labels {numbers} are not kept, as they are no anatomical terms: give "
            f"them with --names {hidden[0]}=NAME"
        )
    return names, said
