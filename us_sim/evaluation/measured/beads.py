"""Displacements of beads in a gel, from their positions in two images and some known links.

The authors of SerialTrack (J. Yang et al., SoftwareX 19, 101204, 2022) linked most beads; where
the strain is large many are left. Their links deep in the gel, where they are sure, are the seeds;
from there links grow upwards: an unlinked bead is expected where a local affine fit of its linked
neighbours puts it, and is linked with the nearest bead there if each is the other's nearest.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.spatial import KDTree

from us_sim.errors import UsSimError

Array = NDArray[np.float64]

FILE = "results_3D_hardpar.mat"

_UNREADABLE = (
    *(OSError, ValueError, TypeError, KeyError, IndexError, NotImplementedError),
    *(MatReadError, zlib.error),
)
_PIXEL = 0.4e-6  # m, of the authors' script
_SURE = 120.0  # pixels, height up to which the authors' links are the seeds
_REACH = 2.5  # pixels, from the expected place
_NEIGHBOURS, _LEAST_NEIGHBOURS = 24, 8  # and how many of them must be linked to expect a place
_NEAREST = 20
_SWEEPS = 200
_WELL_LINKED = 0.7  # part of a bead's neighbours that must be linked, or its own link may be wrong


@dataclass(frozen=True)
class Beads:
    """Beads before the indentation, and how they moved."""

    places: Array  # (B, 3) m
    displacement: Array  # (B, 3) m
    volume_ratio: Array  # (B,), measured around each

    def __getitem__(self, chosen: NDArray) -> Beads:
        return Beads(self.places[chosen], self.displacement[chosen], self.volume_ratio[chosen])


def read_beads(file: Path) -> Beads:
    """Well linked beads of the authors' file of results.

    Raises:
        UsSimError: the file cannot be read, or has not two sets of beads and links between them.
    """
    try:
        content = loadmat(file)
        before, after = (
            np.asarray(places, dtype=float) for places in content["parCoord_prev"].ravel()
        )
        links = content["track_A2B_prev"].ravel()[0].ravel().astype(np.int64) - 1
    except _UNREADABLE as error:
        problem = str(error).strip().split("\n")[0]
        raise UsSimError(
            f"{file}: cannot be read as SerialTrack's results ({problem}); fetch it again"
        ) from error
    shaped = all(places.ndim == 2 and places.shape[1] == 3 for places in (before, after))
    if not shaped or links.shape != (len(before),) or links.max(initial=-1) >= len(after):
        raise UsSimError(
            f"{file}: beads of shape {before.shape} and {after.shape} do not go with "
            f"{len(links)} links up to {links.max(initial=-1) + 1}; fetch it again"
        )
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        raise UsSimError(f"{file}: has a bead whose position is not finite; fetch it again")
    seeds = np.where(before[:, 2] < _SURE, links, -1)
    if (count := int((seeds >= 0).sum())) < 1000:
        raise UsSimError(f"{file}: {count} links deep in the gel are too few; fetch it again")
    partners = grow_links(before, after, seeds)
    linked = partners >= 0
    well = linked & (linked[_neighbours(before)].mean(axis=1) > _WELL_LINKED)
    moved = np.zeros_like(before)
    moved[linked] = after[partners[linked]] - before[linked]
    _, slope = local_fit(before[linked], moved[linked], before[well], _NEIGHBOURS)
    ratio = np.linalg.det(np.eye(3) + slope)
    return Beads(_PIXEL * before[well], _PIXEL * moved[well], ratio)


def grow_links(before: Array, after: Array, links: NDArray[np.int64]) -> NDArray[np.int64]:
    """(A,) partner of each bead before (A, 3) among those after (B, 3), or -1; pixels.

    Args:
        links: (A,), the seeds.
    """
    links = links.copy()
    neighbours = _neighbours(before)
    for _ in range(_SWEEPS):
        linked = links >= 0
        asked = np.flatnonzero(~linked & (linked[neighbours].sum(axis=1) >= _LEAST_NEIGHBOURS))
        left = np.setdiff1d(np.arange(len(after)), links[linked])
        if not len(asked) or not len(left):
            break
        moved = after[links[linked]] - before[linked]
        expected = before[asked] + local_fit(before[linked], moved, before[asked], _NEAREST)[0]
        distance, found = KDTree(after[left]).query(expected)
        _, back = KDTree(expected).query(after[left])
        sure = (distance < _REACH) & (back[found] == np.arange(len(asked)))
        if not sure.any():
            break
        links[asked[sure]] = left[found[sure]]
    return links


def local_fit(
    places: Array, moved: Array, points: Array, nearest: int, *, quadratic: bool = False
) -> tuple[Array, Array]:
    """Weighted polynomials of the nearest beads around each point.

    Args:
        places, moved: (B, 3), beads and their displacement.
        points: (P, 3).

    Returns:
        (P, 3) the displacement at the points, and (P, 3, 3) its slope, by component and axis.
    """
    distance, chosen = KDTree(places).query(points, nearest)
    x = (places[chosen] - points[:, None]) / distance[:, -1:, None]
    terms = [np.ones(x.shape[:2]), *np.moveaxis(x, 2, 0)]
    if quadratic:
        terms += [x[..., i] * x[..., j] for i in range(3) for j in range(i + 1)]
    weight = np.sqrt(np.maximum(1 - (x**2).sum(axis=2), 1e-3))
    matrix = np.stack(terms, axis=2) * weight[..., None]
    solved = np.linalg.pinv(matrix) @ (moved[chosen] * weight[..., None])
    return solved[:, 0], solved[:, 1:4].swapaxes(1, 2) / distance[:, -1:, None]


def _neighbours(places: Array) -> NDArray[np.int64]:
    return np.asarray(KDTree(places).query(places, _NEIGHBOURS + 1)[1][:, 1:])
