"""Volumes in the user's cache folder, memory-mapped by all processes that use them.

>>> import os, tempfile
>>> from us_sim.volume.phantom.phantom_cache import kept_volume
>>> from us_sim.volume.phantom.phantom import upper_arm
>>> with tempfile.TemporaryDirectory() as os.environ["US_SIM_CACHE"]:
...     made = kept_volume("arm", lambda: upper_arm(seed=1, voxel_size=3e-3))
...     kept = kept_volume("arm", lambda: 1 / 0)
...     bool((made.labels == kept.labels).all())
True
>>> del os.environ["US_SIM_CACHE"]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.cache import Form, cache_folder, kept
from us_sim.volume.volume import Volume

__all__ = ["cache_folder", "kept_volume"]


def kept_volume(
    key: str, make: Callable[[], Volume], waiting: Callable[[], None] | None = None
) -> Volume:
    """The labelled volume cached under a key, made first if it is not there.

    Args:
        key: a file name that contains everything on which the volume's bytes depend.
        make: makes the volume; called by one process at a time.
        waiting: called every half second while another process makes it.
    """
    return kept(key, _FORM, make, waiting)


def _pack(volume: Volume) -> tuple[dict[str, NDArray], dict[str, Any]]:
    assert volume.labels is not None  # phantoms are labelled
    arrays: dict[str, NDArray] = {"intensities": volume.intensities, "labels": volume.labels}
    return arrays, {
        "index_to_patient": volume.index_to_patient.tolist(),
        "label_names": volume.label_names,
    }


def _unpack(arrays: dict[str, NDArray], facts: dict[str, Any]) -> Volume:
    return Volume(
        arrays["intensities"],
        np.array(facts["index_to_patient"]),
        arrays["labels"],
        {int(label): name for label, name in facts["label_names"].items()},
    )


_FORM = Form("volume.json", _pack, _unpack)
