"""Which of a volume's labels fills most of each tetrahedron.

>>> import numpy as np
>>> from us_sim.slicing.strain.main_label import main_labels
>>> from us_sim.volume.volume import Volume
>>> labels = np.repeat(np.array([1, 1, 4, 4], np.uint8), 16).reshape(4, 4, 4)
>>> volume = Volume(labels, np.eye(4), labels)
>>> nodes = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3], [3, 3, 0], [3, 0, 3]])
>>> main_labels(nodes, np.array([[0, 1, 2, 3], [1, 4, 5, 3]]), volume).tolist()
[1, 4]
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from us_sim.volume.volume import Volume

_PARTS = 5
"""Of an edge: the points that are looked up lie evenly, 56 in each tetrahedron."""


def main_labels(
    nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer], volume: Volume
) -> NDArray[np.uint8]:
    """(M,) the label with most of some evenly spaced points; 0 without labels.

    Args:
        nodes: (N, 3) m, at rest. tetrahedra: (M, 4).
    """
    if volume.labels is None:
        return np.zeros(len(tetrahedra), dtype=np.uint8)
    to_index = volume.patient_to_index
    index = nodes @ to_index[:3, :3].T + to_index[:3, 3]
    last = np.array(volume.shape) - 1
    corners = index[tetrahedra]
    most = np.zeros(len(tetrahedra), dtype=np.int16)
    found = np.zeros(len(tetrahedra), dtype=np.uint8)
    seen = np.stack(
        [
            volume.labels[tuple(np.clip(np.rint(place), 0, last).astype(np.intp).T)]
            for place in (np.einsum("k,ekj->ej", weight, corners) for weight in _weights())
        ],
        axis=1,
    )
    for label in np.unique(seen):
        count = (seen == label).sum(axis=1, dtype=np.int16)
        more = count > most
        most[more], found[more] = count[more], label
    return found


def _weights() -> list[NDArray[np.float64]]:
    """Barycentric coordinates (4,) of evenly spaced points, none of them on a face."""
    counts = itertools.product(range(_PARTS + 1), repeat=3)
    inner = [(*each, _PARTS - sum(each)) for each in counts if sum(each) <= _PARTS]
    return [(np.array(each) + 0.25) / (_PARTS + 1.0) for each in inner]
