"""Where voxels are in a vessel: found once, and kept for the next start.

>>> import os, tempfile
>>> import numpy as np
>>> from us_sim.slicing.flow.lumen_map import mapped_lumen
>>> from us_sim.volume.volume import Volume
>>> x, z = np.meshgrid(np.arange(21) - 10, np.arange(21) - 10, indexing="ij")
>>> tube = np.repeat((x**2 + z**2 < 36)[:, None], 60, axis=1).astype(np.uint8)
>>> volume = Volume(tube, np.diag([5e-4, 5e-4, 5e-4, 1.0]), tube, {1: "vein"})
>>> with tempfile.TemporaryDirectory() as os.environ["US_SIM_CACHE"]:
...     lumen, places = mapped_lumen(volume, 1)
...     again, _ = mapped_lumen(volume, 1)
>>> del os.environ["US_SIM_CACHE"]
>>> bool((again.radii == lumen.radii).all()), places.offset.shape
(True, (15, 64, 15, 2))
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.cache import Form, kept
from us_sim.slicing.flow.lumen import Lumen, lumen_of
from us_sim.volume.volume import Volume

_WAY = 1
"""Raised when another lumen or map is made of the same voxels."""
_OUTSIDE = 3.0  # radial coordinate that is well outside the wall
_MARGIN = 2  # voxels beyond the wall in which coordinates are known


@dataclass(frozen=True, eq=False)
class LumenMap:
    """Place along a vessel, and offset across it as `Lumen.locate` says, of voxels around it.

    The offset is kept and not the radial coordinate, since it is as good as linear from voxel to
    voxel.
    """

    station: NDArray[np.float32]  # (I, J, K)
    offset: NDArray[np.float32]  # (I, J, K, 2)
    corner: NDArray[np.int64]  # (3,), the volume's voxel that cell (0, 0, 0) is


def mapped_lumen(volume: Volume, label: int) -> tuple[Lumen, LumenMap]:
    """The lumen of a label, and the map of the voxels around it; from the cache if it is there.

    Raises:
        VolumeError: as `lumen_of`.
    """
    assert volume.labels is not None
    inside = volume.labels == label
    about = hashlib.sha256(np.packbits(inside))
    about.update(repr((_WAY, inside.shape, volume.index_to_patient.tolist())).encode())

    def make() -> tuple[Lumen, LumenMap]:
        lumen = lumen_of(inside, volume.index_to_patient)
        return lumen, _map(lumen, inside, volume.index_to_patient)

    return kept(f"lumen-{about.hexdigest()[:16]}", _FORM, make)


def _map(lumen: Lumen, inside: NDArray[np.bool_], to_patient: NDArray[np.float64]) -> LumenMap:
    voxels = np.argwhere(inside)
    low, high = voxels.min(axis=0) - _MARGIN, voxels.max(axis=0) + _MARGIN + 1
    shape = tuple(high - low)
    index = np.indices(shape).reshape(3, -1).T + low
    station, offset = lumen.locate(index @ to_patient[:3, :3].T + to_patient[:3, 3])
    return LumenMap(
        station.astype(np.float32).reshape(shape),
        np.clip(offset, -_OUTSIDE, _OUTSIDE).astype(np.float32).reshape(*shape, 2),
        low,
    )


def _pack(found: tuple[Lumen, LumenMap]) -> tuple[dict[str, NDArray], dict[str, Any]]:
    lumen, places = found
    arrays: dict[str, NDArray] = {**vars(lumen), **vars(places)}
    return {name: arrays[name] for name in (*_OF_LUMEN, *_OF_MAP)}, {}


def _unpack(arrays: dict[str, NDArray], _: dict[str, Any]) -> tuple[Lumen, LumenMap]:
    own = {name: np.array(array) for name, array in arrays.items()}  # kernels take no read-only
    return (
        Lumen(**{name: own[name] for name in _OF_LUMEN}),
        LumenMap(**{name: own[name] for name in _OF_MAP}),
    )


_OF_LUMEN = ("centres", "tangents", "across", "radii")
_OF_MAP = ("station", "offset", "corner")
_FORM = Form("lumen.json", _pack, _unpack)
