"""Procedural phantoms: labelled ultrasound volumes made from a seed, and cached."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim import Progress
from us_sim.cache import cache_folder, load_or_create
from us_sim.errors import VolumeError
from us_sim.settings.registry import PHANTOMS
from us_sim.volume.settings import SEED, VOXEL_SIZE
from us_sim.volume.volume import Volume

_GENERATOR = 2
"""Part of the cache's key: raise it when a change here, or in what this calls, changes a phantom's
bytes."""


def make_upper_arm(
    seed: int = 1,
    voxel_size: float = 0.3e-3,
    progress: Progress | None = None,
    *,
    thrombus: tuple[float, float] | None = None,
) -> Volume:
    """Make a labelled upper arm, its skin at z = 0, and its echoes over 60 dB without loss.

    The same seed and voxel size give the same bytes with the same NumPy and SciPy (bit generator
    PCG64); another voxel size shows the same anatomy with other speckle.

    Args:
        seed: not negative.
        voxel_size: m, 0.2 mm (1.1 GB while it is made) to 5 mm.
        progress: told the fraction done and the work in progress.
        thrombus: from and to, m along y, where one fills the vein; one without a length is none.

    Raises:
        VolumeError: the seed or the voxel size is out of range.
    """
    # A phantom that is kept needs none of it, and a node should start quickly.
    from us_sim.volume.phantom.upper_arm import (
        UPPER_ARM_BLOCK,
        PointSpread,
        UpperArm,
        compute_envelope,
        log_compress,
    )

    for name, quantity, value in (("seed", SEED, seed), ("voxel size", VOXEL_SIZE, voxel_size)):
        try:
            quantity.parse(value)
        except ValueError as error:
            raise VolumeError(f"the {name} of a phantom: {error}") from error
    report = progress or (lambda *_: None)
    shape = np.ceil(np.diff(UPPER_ARM_BLOCK, axis=0)[0] / voxel_size - 1e-6).astype(int)
    lower = UPPER_ARM_BLOCK.mean(axis=0) - shape / 2 * voxel_size
    lower[2] = UPPER_ARM_BLOCK[0, 2]
    spread = PointSpread()
    depth = np.arange(shape[2]) * voxel_size
    margin = np.ceil(np.array(spread.compute_reach(depth)) / voxel_size).astype(int)
    x, y, z = (
        lower[axis] + (np.arange(-margin[axis], shape[axis] + margin[axis]) + 0.5) * voxel_size
        for axis in range(3)
    )
    inside = tuple(slice(m, m + n) for m, n in zip(margin, shape, strict=True))

    arm = UpperArm(seed, thrombus)
    labels = np.empty((len(x), len(y), len(z)), dtype=np.uint8)
    diffuse = np.empty(labels.shape, dtype=np.float32)
    specular = np.empty(labels.shape, dtype=np.float32)
    # Products of matrices this small take five times as long on several threads.
    with threadpool_limits(1, user_api="blas"):
        for j, at in enumerate(y):
            section = arm.cut_section(x, float(at), z)
            labels[:, j], diffuse[:, j] = section.labels, section.diffuse
            specular[:, j] = section.specular
            if j % 10 == 0:
                report(0.8 * j / len(y), "laying out the tissue")
    report(0.8, "scattering")
    random = np.random.Generator(np.random.PCG64([seed, 1]))
    envelope = compute_envelope(diffuse, specular, voxel_size, z, spread, random)
    del diffuse, specular
    report(0.95, "compressing")
    placement = np.diag([voxel_size, voxel_size, voxel_size, 1.0])
    placement[:3, 3] = lower + 0.5 * voxel_size
    volume = Volume(
        log_compress(np.ascontiguousarray(envelope[inside])),
        placement,
        labels[inside],
        {number: name for name, number in arm.labels.items()},
    )
    report(1.0, "done")
    return volume


thrombosed_arm = partial(make_upper_arm, thrombus=(-9e-3, 9e-3))


def draw_arm(seed: int = 1, voxel_size: float = 0.3e-3, progress: Progress | None = None) -> Volume:
    """Make an arm whose seed decides, too, whether a thrombus is in its vein, and where.

    All else is as for `make_upper_arm`.
    """
    return make_upper_arm(seed, voxel_size, progress, thrombus=draw_thrombus(seed))


def draw_thrombus(seed: int) -> tuple[float, float]:
    """Draw where a thrombus begins and ends, m along y; in half of the arms there is none.

    >>> draw_thrombus(1) == draw_thrombus(1)
    True
    """
    random = np.random.Generator(np.random.PCG64([seed, 2]))
    is_there, length = bool(random.integers(2)), random.uniform(12e-3, 20e-3)
    begin = random.uniform(-22e-3, 22e-3 - length)
    return (float(begin), float(begin + length)) if is_there else (0.0, 0.0)


def load_or_make_phantom(
    name: str, seed: int = 1, voxel_size: float = 0.3e-3, progress: Progress | None = None
) -> Volume:
    """Load a phantom from the user's cache folder, made there first if it is not in it yet.

    Its arrays are memory-mapped, one copy for all processes. Processes that ask at once wait for
    the one that makes it; a damaged entry is made again, and a warning is logged. ``progress`` is
    told the fraction done and the work in progress while a phantom is made.

    Raises:
        VolumeError: ``name`` is none of PHANTOMS, or the seed or voxel size (m) is out of range.

    Examples:
        >>> arm = load_or_make_phantom("upper_arm", seed=1, voxel_size=2e-3)
        >>> arm.shape, arm.label_names[6]
        ((36, 30, 27), 'vein')
    """
    make: Callable[[int, float, Progress | None], Volume] = PHANTOMS.load(name)
    key = _key(name, seed, voxel_size)
    return load_or_create(key, pack_volume, unpack_volume, lambda: make(seed, voxel_size, progress))


def is_phantom_cached(name: str, seed: int, voxel_size: float) -> bool:
    """Tell whether a phantom is in the user's cache folder; it may be damaged."""
    return (cache_folder() / _key(name, seed, voxel_size)).is_dir()


def _key(name: str, seed: int, voxel_size: float) -> str:
    """Return a file name of all that decides the phantom's bytes."""
    decided_by = f"{name} {_GENERATOR} {int(seed)} {float(voxel_size)!r}"
    return f"{name}-{hashlib.sha256(decided_by.encode()).hexdigest()[:16]}"


def pack_volume(volume: Volume) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Take a labelled volume apart, for the cache."""
    assert volume.labels is not None  # phantoms are labelled
    return {"intensities": volume.intensities, "labels": volume.labels}, {
        "index_to_patient": volume.index_to_patient.tolist(),
        "label_names": volume.label_names,
    }


def unpack_volume(arrays: dict[str, NDArray], facts: dict[str, Any]) -> Volume:
    """Make a volume of what `pack_volume` returned."""
    return Volume(
        arrays["intensities"],
        np.array(facts["index_to_patient"]),
        arrays["labels"],
        {int(label): name for label, name in facts["label_names"].items()},
    )
