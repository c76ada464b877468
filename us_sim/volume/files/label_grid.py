"""Labels of one grid on another: moved where their voxels are the same, resampled where asked.

>>> import numpy as np
>>> from us_sim.volume.files.label_grid import on_grid
>>> part = np.full((2, 2, 2), 6, np.uint8)
>>> moved = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> moved[:3, 3] = (3e-3, 0, 1e-3)
>>> whole, remarks = on_grid(part, moved, (8, 4, 4), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
>>> np.argwhere(whole)[0], remarks
(array([3, 0, 1]), [])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError

_SAME = 0.02
"""Voxels by which two grids may differ and still be one; single precision, which NIfTI has, makes
them differ by less."""


def on_grid(
    labels: NDArray[np.uint8],
    placement: NDArray[np.float64],
    shape: tuple[int, int, int],
    wanted: NDArray[np.float64],
    *,
    resample: bool = False,
) -> tuple[NDArray[np.uint8], list[str]]:
    """The labels on a grid of that shape, and what a person should know of that.

    A file may hold only the part of a volume that is labelled, or its axes in another order or
    direction; its voxels are then those of the volume, and nothing is resampled.

    Args:
        labels: (i, j, k) of the file.
        placement: (4, 4) m, from the file's indices.
        shape: of the grid that they shall be on.
        wanted: (4, 4) m, from its indices.
        resample: take the nearest voxel where the grids differ.

    Raises:
        VolumeError: the grids differ and ``resample`` is not given, or nothing of the labels lies
            within the grid; the sentence does not say of which file.
    """
    to_grid = np.linalg.inv(wanted) @ placement
    turn = np.rint(to_grid[:3, :3])
    shift = np.rint(to_grid[:3, 3])
    corners = np.stack(np.meshgrid(*[[0, n - 1] for n in labels.shape], indexing="ij"), axis=-1)
    corners = corners.reshape(-1, 3)
    apart = corners @ (to_grid[:3, :3] - turn).T + to_grid[:3, 3] - shift
    is_turn = np.array_equal(np.abs(turn).sum(axis=0), np.ones(3)) and np.array_equal(
        np.abs(turn).sum(axis=1), np.ones(3)
    )
    before = np.count_nonzero(labels)
    remarks = []
    if is_turn and np.abs(apart).max() <= _SAME:
        made = _placed(labels, turn.astype(int), shift.astype(int), shape)
    elif resample:
        to_file = np.linalg.inv(to_grid)
        made = ndimage.affine_transform(
            labels, to_file[:3, :3], to_file[:3, 3], output_shape=shape, order=0, mode="constant"
        )
        remarks.append(
            f"labels of {_words(labels.shape, placement)} were resampled to {_words(shape, wanted)}"
            f" by the nearest voxel"
        )
    else:
        raise VolumeError(
            f"its labels are on another grid ({_words(labels.shape, placement)}) than the volume "
            f"({_words(shape, wanted)}): segment this volume, or have them resampled with "
            f"--resample"
        )
    if before and not made.any():
        raise VolumeError(
            "its labels lie wholly outside the volume: they belong to another one, or their axes "
            "were taken for others (left-posterior-superior is meant)"
        )
    if not remarks and (lost := before - np.count_nonzero(made)):
        remarks.append(
            f"{lost} of {before} labelled voxels lie outside the volume and are left out"
        )
    return made, remarks


def _placed(
    labels: NDArray[np.uint8],
    turn: NDArray[np.int64],
    shift: NDArray[np.int64],
    shape: tuple[int, int, int],
) -> NDArray[np.uint8]:
    """Labels whose index n is turn @ n + shift in an array of that shape."""
    order = np.argmax(np.abs(turn), axis=1)  # the file's axis along each of the grid's
    turned = labels.transpose(order)
    signs = turn[np.arange(3), order]
    turned = turned[tuple(slice(None, None, int(sign)) for sign in signs)]
    first = np.where(signs > 0, shift, shift - np.array(turned.shape) + 1)
    last = np.minimum(first + turned.shape, shape)
    start = np.maximum(first, 0)
    made = np.zeros(shape, np.uint8)
    if (last > start).all():
        there = tuple(slice(a, b) for a, b in zip(start, last, strict=True))
        here = tuple(slice(a, b) for a, b in zip(start - first, last - first, strict=True))
        made[there] = turned[here]
    return made


def _words(shape: tuple[int, ...], placement: NDArray[np.float64]) -> str:
    sides = np.linalg.norm(placement[:3, :3], axis=0) * 1e3
    return (
        f"{' × '.join(map(str, shape))} voxels of {' × '.join(f'{side:.3g}' for side in sides)} mm"
    )
