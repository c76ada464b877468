"""The arm at five tilts beside cast rays, and the run time of its images.

Rays in double precision, independent of how `us_sim.slicing.acoustics` goes about it: for each
pixel one from the face along its beam adds up the loss in soft tissue, and others from the whole
aperture the loss in bone and gas, in steps of a tenth of a millimetre through the volume at rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.image.measure import row_of, tilted, time_row
from us_sim.evaluation.timing import medians_in_turn
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.scene.building import probe_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.slicing.acoustics.beam_acoustics import BeamAcoustics
from us_sim.slicing.acoustics.media import aperture, constants_by_label, crossing_loss
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import Imaging
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

_STEP = 0.1e-3  # m
_RAYS = 33  # from the aperture to a pixel


def _traced_gain(
    volume: Volume, probe: Probe, pose: Pose, acoustics: Acoustics
) -> NDArray[np.float64]:
    """(rows, columns) dB by which each pixel's echo is changed; NaN where no beam reaches."""
    assert volume.labels is not None
    per_metre = 200.0 * acoustics.frequency_among(probe.frequencies) * 1e-6
    by_label = constants_by_label(volume, acoustics)
    impedance, taken = np.full(256, np.nan), np.zeros(256)
    fibres, falls = np.zeros((256, 3)), np.zeros((256, 2))
    for label, tissue in by_label.items():
        assert tissue.impedance is not None
        assert tissue.attenuation is not None
        impedance[label], taken[label] = tissue.impedance, per_metre * tissue.attenuation
        if tissue.has_fibres:
            fibres[label] = np.array(tissue.fibres) / np.linalg.norm(np.array(tissue.fibres))
            falls[label] = tissue.anisotropy, np.sin(tissue.half_angle) ** 2
    blocks = (impedance < 0.8e6) | (impedance > 3.0e6)  # Rayl
    nominal = np.where(blocks, np.minimum(taken, per_metre * acoustics.compensation), taken)
    borders = np.zeros((256, 256))
    for a in by_label:
        for b in by_label:
            borders[a, b] = crossing_loss(impedance[a], impedance[b])
    line, distance = probe.pixel_beams.astype(np.float64)
    starts, directions = probe.rays(((line + 0.5) / probe.lines).reshape(-1))
    across, down = pose.rotation[:, 0], pose.rotation[:, 2]
    start = pose.position + starts[:, :1] * across + starts[:, 1:] * down
    along = directions[:, :1] * across + directions[:, 1:] * down
    sideways = directions[:, 1:] * across - directions[:, :1] * down
    away = distance.reshape(-1)
    wide = aperture(probe, np.nan_to_num(away, nan=1.0))
    gain = np.empty(len(away))
    to_index = volume.patient_to_index[:3, :3].T
    turned = (
        start @ to_index + volume.patient_to_index[:3, 3],
        along @ to_index,
        sideways @ to_index,
    )
    _trace(
        *turned, along, away, wide, volume.labels, nominal, taken - nominal,
        borders, blocks, fibres, falls, per_metre * acoustics.compensation, gain,
    )  # fmt: skip
    return gain.reshape(line.shape)


@njit(cache=True, nogil=True, error_model="numpy")
def _trace(
    start, ahead, sideways, along, away, wide, labels, soft, hard, borders, blocks, fibres,
    falls, rise, gain,
):  # fmt: skip
    """Fills gain (pixels,) dB; start, ahead and sideways (pixels, 3) are in voxels."""
    end = np.empty(3)
    element = np.empty(3)
    for p in range(len(away)):
        if not away[p] >= 0.0:
            gain[p] = np.nan
            continue
        for a in range(3):
            end[a] = start[p, a] + away[p] * ahead[p, a]
            element[a] = start[p, a]
        lost = _ray(element, end, away[p], labels, soft, borders, blocks, False)
        light = 0.0
        for r in range(_RAYS):
            offset = ((r + 0.5) / _RAYS - 0.5) * wide[p]
            for a in range(3):
                element[a] = start[p, a] + offset * sideways[p, a]
            length = np.hypot(away[p], offset)
            blocked = _ray(element, end, length, labels, hard, borders, blocks, True)
            light += 10.0 ** (-blocked / 20.0) / _RAYS
        own = _label(end[0], end[1], end[2], labels)
        sine = 0.0
        for a in range(3):
            sine += fibres[own, a] * along[p, a]
        fall = falls[own, 0] * sine * sine / (sine * sine + falls[own, 1] + 1e-12)
        gain[p] = rise * away[p] - lost - fall + 20.0 * np.log10(max(light, 1e-6))


@njit(cache=True, nogil=True, error_model="numpy")
def _ray(start, end, length, labels, taken, borders, blocks, of_blockers):
    """dB lost along the way and at borders, in blockers or in all other tissue.

    Args:
        start, end: (3,) voxels. length: m. taken: (256,) dB/m. borders: (256, 256) dB.
    """
    count = max(1, int(np.ceil(length / _STEP)))
    x = (end[0] - start[0]) / count
    y = (end[1] - start[1]) / count
    z = (end[2] - start[2]) / count
    lost = 0.0
    was = -1
    for s in range(count):
        t = s + 0.5
        own = _label(start[0] + t * x, start[1] + t * y, start[2] + t * z, labels)
        lost += taken[own] * length / count
        if was >= 0 and own != was and (blocks[own] or blocks[was]) == of_blockers:
            lost += borders[was, own]
        was = own
    return lost


@njit(inline="always", error_model="numpy")
def _label(x, y, z, labels):
    i = int(np.floor(x + 0.5))
    j = int(np.floor(y + 0.5))
    k = int(np.floor(z + 0.5))
    if 0 <= i < labels.shape[0] and 0 <= j < labels.shape[1] and 0 <= k < labels.shape[2]:
        return np.int64(labels[i, j, k])
    return np.int64(255)  # nothing, which takes nothing


_TILTS = (-20.0, -10.0, 0.0, 10.0, 20.0)


def arm_rows(quick: bool) -> Iterator[dict[str, Any]]:
    """The whole of it, in an arm: the gain of every pixel against rays; the images are hidden."""
    scene = load_scene("upper_arm")
    volume, side = volume_of(scene), 96 if quick else 320
    deep: Any = probe_of(scene)
    probe = dataclasses.replace(deep, depth=0.054).with_pixels(side, round(1.35 * side))
    acoustics = scene.imaging.acoustics
    all_of_it = BMode(volume, probe, Imaging(), acoustics)
    bare = dataclasses.replace(acoustics, surfaces=False, noise=None)
    without = BMode(volume, probe, Imaging(), bare)
    sound = BeamAcoustics(volume, probe, bare)
    # The probe turns about the bone, so that it stays in view.
    bone, from_bone = np.array([12e-3, 0.0, 38e-3]), np.array([-6e-3, 0.0, -36e-3])  # m
    for degrees in _TILTS[::2] if quick else _TILTS:
        turned = tilted(degrees)
        pose = Pose(bone + turned.rotation @ from_bone, turned.orientation)
        frame = without.frame(pose)
        slice_ = frame.slice(frame.plane)
        shown = sound.gain_on_pixels(frame)
        traced = _traced_gain(volume, probe, pose, acoustics)
        usable = (slice_ > 0) & (traced > -40.0)
        off = np.abs(shown - traced)[usable]
        reference = np.clip(slice_ + 4.25 * traced, 0, 255) * (slice_ > 0)
        images = {
            "all artefacts": all_of_it.image(pose),
            "loss, shadows, fibres": without.image(pose),
            "by rays": reference.astype(np.uint8),
        }
        for name, percent in (("median", 50), ("p95", 95)):
            value = float(np.percentile(off, percent))
            row = row_of(f"arm_{name}", "linear", degrees, float("nan"), 0.0, value, "dB")
            yield {**row, "images": images}


def run_time_rows(quick: bool) -> Iterator[dict[str, Any]]:
    """Images of 512 × 512 of the pressed arm, in turn, so that all have the same disturbances."""
    scene = load_scene("upper_arm")
    volume, probe = volume_of(scene), probe_of(scene).with_pixels(512, 512)
    full = scene.imaging.acoustics
    none = dataclasses.replace(full, surfaces=False, anisotropy=False, noise=None)
    kinds: dict[str, Acoustics | None] = {
        "slice": None,
        "loss": none,
        "loss_and_surfaces": dataclasses.replace(none, surfaces=True),
        "loss_and_fibres": dataclasses.replace(none, anisotropy=True),
        "all": full,
    }
    sides = zip(((-0.036, 0.036), (-0.03, 0.03), (0.0, 0.054)), (32, 16, 16), strict=True)
    mesh, press = box_mesh(*(uniform_planes(*side, n) for side, n in sides)), 8e-3  # m
    x, y, z = mesh.nodes.T
    nodes = mesh.nodes.copy()
    nodes[:, 2] += press * np.exp(-(x**2 + y**2) / 0.02**2) * (1.0 - z / 0.054)
    scanners = {}
    for name, acoustics in kinds.items():
        scanners[name] = BMode(volume, probe, Imaging(), acoustics)
        scanners[name].prepare(probe, Imaging(), acoustics)
        scanners[name].carry(mesh.nodes, mesh.tetrahedra)

    def shown(scanner: BMode) -> Callable[[Pose], object]:
        return lambda pose: scanner.image(pose, nodes)

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        medians = medians_in_turn(
            {name: shown(scanner) for name, scanner in scanners.items()},
            60 if quick else 300,
            5,
            prepare=lambda number: Pose(np.array([2e-4 * (number % 7), 0.0, press])),
        )
    finally:
        cv2.setNumThreads(threads)
    for name, ms in medians.items():
        yield {**time_row(f"run_time_{name}", ms), "measured": ms, "unit": "ms"}
