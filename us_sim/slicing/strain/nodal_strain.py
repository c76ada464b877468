"""How much tissue is deformed in the plane of an image: of tetrahedra, smoothed to their nodes.

A tissue line that now lies along the unit vector d was 1 / λ times as long in another state, with
1 / λ² = d · c d. The tensor c = F⁻ᵀ F⁻¹ is Cauchy's deformation tensor (the inverse of the left
Cauchy–Green tensor; Holzapfel, *Nonlinear Solid Mechanics*, 2000, section 2.5); F maps that state
to now. It is constant in a linear tetrahedron. What a node has is the mean over the tetrahedra
around it, weighted by their volumes, as averaged gradients are recovered from finite elements
(Zienkiewicz and Zhu, Int. J. Numer. Methods Eng. 24:337, 1987); between nodes it is linear, so that
tetrahedra do not show as steps. Strain does jump from one tissue to another: where the mesh's
tetrahedra are told apart, only those of one tissue are averaged. A turn of the tissue, even one
that differs from tetrahedron to tetrahedron, leaves c as it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.cutting.barycentric import adjugate, is_solid


class Corners(NamedTuple):
    """The P corners that tetrahedra of one tissue share: a node between two tissues is two."""

    numbers: NDArray[np.int32]  # (M, 4) of the tetrahedra's corners
    starts: NDArray[np.int64]  # (P + 1,) of the list of tetrahedra around each, one after the other
    members: NDArray[np.int32]  # (starts[-1],)


def corners_by_tissue(tetrahedra: NDArray[np.int32], tissue: NDArray[np.integer]) -> Corners:
    """Corners over which strain is averaged, and not from one tissue to another.

    Args:
        tetrahedra: (M, 4). tissue: (M,) which one each is of, at least 0.
    """
    width = int(tissue.max(initial=0)) + 1
    keys = tetrahedra.astype(np.int64) * width + np.asarray(tissue, dtype=np.int64)[:, None]
    _, numbers = np.unique(keys.ravel(), return_inverse=True)
    numbers = numbers.ravel()  # NumPy 2.0 gives it the shape of the keys
    count = int(numbers.max(initial=-1)) + 1
    starts = np.zeros(count + 1, dtype=np.int64)
    np.cumsum(np.bincount(numbers, minlength=count), out=starts[1:])
    members = (np.argsort(numbers, kind="stable") // 4).astype(np.int32)
    return Corners(numbers.reshape(-1, 4).astype(np.int32), starts, members)


@njit(cache=True, nogil=True, error_model="numpy")
def nodal_deformation(
    shown, tetrahedra, corners, starts, members, before, now, to_pixel, pixel_volume, steps, place,
    deformed, done, mean,
):  # fmt: skip
    """Fills ``mean`` (P, 3) at the corners of the tetrahedra that are shown.

    It is c in the image's plane: lateral by lateral, lateral by axial, axial by axial. A corner
    around which all tetrahedra are inverted or flat is left without deformation: 1, 0, 1.

    Args:
        shown: (E,) numbers of tetrahedra. tetrahedra: (M, 4) nodes.
        corners, starts, members: as `Corners`.
        before, now: (N, 3) m, nodes in the other state and now.
        to_pixel: (3, 4) from m to column, row and height. pixel_volume: m³ per unit of those.
        steps: (2,) m, from one column to the next, and from one row to the next.
        place: (N, 3) column, row and height of the nodes now, filled here.
        deformed: (M, 4) room for volume and c of tetrahedra. done: (M + P,) bool, room.
    """
    for n in range(len(now)):
        for a in range(3):
            place[n, a] = (
                to_pixel[a, 3]
                + to_pixel[a, 0] * now[n, 0]
                + to_pixel[a, 1] * now[n, 1]
                + to_pixel[a, 2] * now[n, 2]
            )
    for i in range(len(done)):
        done[i] = False
    count = len(tetrahedra)
    for s in shown:
        for k in range(4):
            n = corners[s, k]
            if done[count + n]:
                continue
            done[count + n] = True
            volume = 0.0
            first = 0.0
            mixed = 0.0
            last = 0.0
            for q in range(starts[n], starts[n + 1]):
                e = members[q]
                if not done[e]:
                    done[e] = True
                    _deform(tetrahedra, e, before, place, pixel_volume, steps, deformed)
                volume += deformed[e, 0]
                first += deformed[e, 0] * deformed[e, 1]
                mixed += deformed[e, 0] * deformed[e, 2]
                last += deformed[e, 0] * deformed[e, 3]
            mean[n, 0] = first / volume if volume > 0.0 else 1.0
            mean[n, 1] = mixed / volume if volume > 0.0 else 0.0
            mean[n, 2] = last / volume if volume > 0.0 else 1.0


@njit(inline="always", error_model="numpy")
def _deform(tetrahedra, e, before, place, pixel_volume, steps, deformed):
    """Fills a tetrahedron's row: its volume now in any unit (0 if it is not solid), and c."""
    n0 = tetrahedra[e, 0]
    n1 = tetrahedra[e, 1]
    n2 = tetrahedra[e, 2]
    n3 = tetrahedra[e, 3]
    size, to_1, to_2, to_3 = adjugate(place, n0, n1, n2, n3)
    ax = before[n1, 0] - before[n0, 0]
    ay = before[n1, 1] - before[n0, 1]
    az = before[n1, 2] - before[n0, 2]
    bx = before[n2, 0] - before[n0, 0]
    by = before[n2, 1] - before[n0, 1]
    bz = before[n2, 2] - before[n0, 2]
    cx = before[n3, 0] - before[n0, 0]
    cy = before[n3, 1] - before[n0, 1]
    cz = before[n3, 2] - before[n0, 2]
    earlier = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    if not is_solid(size, pixel_volume, earlier):
        deformed[e, 0] = 0.0
        deformed[e, 1] = 0.0
        deformed[e, 2] = 0.0
        deformed[e, 3] = 0.0
        return
    # How fast the place in the other state changes along the image's columns and rows.
    p = 1.0 / (size * steps[0])
    ux = p * (to_1[1] * ax + to_2[1] * bx + to_3[1] * cx)
    uy = p * (to_1[1] * ay + to_2[1] * by + to_3[1] * cy)
    uz = p * (to_1[1] * az + to_2[1] * bz + to_3[1] * cz)
    r = 1.0 / (size * steps[1])
    wx = r * (to_1[2] * ax + to_2[2] * bx + to_3[2] * cx)
    wy = r * (to_1[2] * ay + to_2[2] * by + to_3[2] * cy)
    wz = r * (to_1[2] * az + to_2[2] * bz + to_3[2] * cz)
    deformed[e, 0] = abs(size)
    deformed[e, 1] = ux * ux + uy * uy + uz * uz
    deformed[e, 2] = ux * wx + uy * wy + uz * wz
    deformed[e, 3] = wx * wx + wy * wy + wz * wz


@njit(cache=True, nogil=True, error_model="numpy")
def to_pixels(shown, tetrahedra, corners, place, mean, maps):
    """Fills ``maps`` (E, 3, 3): coefficients of (1, column, row) of what corners have.

    Args:
        shown: (E,) numbers of tetrahedra. tetrahedra: (M, 4) nodes. corners: (M, 4).
        place: (N, 3) column, row and height of the nodes.
        mean: (P, 3), as `nodal_deformation` fills it.
    """
    for s in range(len(shown)):
        e = shown[s]
        n0 = tetrahedra[e, 0]
        size, to_1, to_2, to_3 = adjugate(
            place, n0, tetrahedra[e, 1], tetrahedra[e, 2], tetrahedra[e, 3]
        )
        r = 1.0 / size
        for k in range(3):
            at = mean[corners[e, 0], k]
            b = r * (mean[corners[e, 1], k] - at)
            c = r * (mean[corners[e, 2], k] - at)
            d = r * (mean[corners[e, 3], k] - at)
            maps[s, k, 0] = at + b * to_1[0] + c * to_2[0] + d * to_3[0]
            maps[s, k, 1] = b * to_1[1] + c * to_2[1] + d * to_3[1]
            maps[s, k, 2] = b * to_1[2] + c * to_2[2] + d * to_3[2]
