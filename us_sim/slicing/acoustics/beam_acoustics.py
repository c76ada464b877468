"""Echoes as the beams bring them: loss, shadows, surfaces, fibres and noise, put on a slice."""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.slicing.acoustics.media import (
    LOCATED,
    BeamGrid,
    build_media,
    compute_surface_levels,
    convert_attenuation,
)
from us_sim.slicing.acoustics.path_loss import (
    AMPLITUDES,
    allocate_crossings,
    cast_shadows,
    sharpen_borders,
    sharpen_edges,
    trace_beams,
)
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.acoustics.surface_echo import (
    ANGLES,
    GRAIN,
    SurfaceNormals,
    draw_surfaces,
    find_surface_normals,
)
from us_sim.slicing.cutting.resampling import (
    LocatedPixels,
    compute_pixel_to_index,
    get_label_voxels,
    make_full_runs,
)
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import ECHO_RANGE, Imaging
from us_sim.volume.volume import Volume

SPEED_OF_SOUND = 1540.0  # m/s, that scanners take for all soft tissue
_PULSE = 2.0  # wavelengths, the length of a surface's echo
_CROSSINGS = 16  # of each beam there is room for


class BeamAcoustics:
    """Loss, shadows, surfaces and fibres, as one probe's beams meet them in one volume.

    Raises:
        ProbeError: a volume without labels, a label without constants, constants of a label that
            there is not, or a frequency that the probe does not have.
    """

    def __init__(self, volume: Volume, probe: Probe, acoustics: Acoustics) -> None:
        self._volume, self._acoustics = volume, acoustics
        if volume.labels is None:
            raise acoustics.make_error(
                "artefacts",
                "`live` needs to know what is where, and the volume has no labels: say `baked`, or "
                "give a volume with a segmentation",
            )
        self._voxels, self._shape = get_label_voxels(volume)
        self.grid = grid = BeamGrid(probe)
        self._probe = probe
        frequency = acoustics.choose_frequency(probe.frequencies)
        self._media, self._constants, directions = build_media(
            volume, acoustics, frequency, grid.step
        )
        rise = convert_attenuation(acoustics.compensation, frequency)
        if not acoustics.attenuation:
            rise = 0.0
        self._time_gain = (rise * grid.distance).astype(np.float32)
        self._rise = np.float32(rise * grid.step)
        self._steps = np.array(LOCATED)
        self._fibres = Fibres(directions) if len(directions) else None
        self._no_fibres = np.zeros((1, 1, 2), dtype=np.float32)
        self._pulse = _PULSE * SPEED_OF_SOUND / frequency
        self._noise = None
        if acoustics.noise is not None:
            self._noise = ElectronicNoise(probe, acoustics.noise, rise)
        self._surface = compute_surface_levels(self._constants)
        self._rest_index = np.empty((0, 3))
        self._corners = np.empty((0, 4), dtype=np.int32)
        self._gain = _apart((grid.samples, grid.beams), np.float32)
        self._blocked, self._blocker = np.zeros_like(self._gain), np.zeros_like(self._gain)
        columns = -(-probe.columns // LOCATED[1])
        self._elements = _apart((-(-probe.rows // LOCATED[0]), columns), np.int32)
        places = grid.places.astype(np.int64)
        places = places // columns * self._elements.shape[1] + places % columns
        self._places = np.ascontiguousarray(places, dtype=np.int32)
        self._crossings = allocate_crossings(_CROSSINGS * grid.beams)
        self._across, self._along = (
            np.ascontiguousarray(grid.directions[:, axis], dtype=np.float32) for axis in (0, 1)
        )
        self._found = 0
        self._at: tuple[LocatedPixels, NDArray[np.float64]]
        self._lines = grid.lines
        self._dither = _dither(probe.columns)
        self._rigid = np.ascontiguousarray(volume.patient_to_index[:3, :3])
        self._origin = -probe.image_to_probe[[0, 2], 3] / probe.pixel_spacing
        plane = probe.make_plane(Pose())
        self._runs = make_full_runs(plane) if plane.spans is None else plane.spans

    def resolve_imaging(self, imaging: Imaging) -> Imaging:
        """Add to the console's settings the blur of a frequency below the volume's own.

        A point is as long as 1.5 wavelengths and as wide as a wavelength times the f-number, 2
        (Szabo 2014, section 6.6). The blur of the volume's own frequency is taken off in squares.
        """
        own = self._acoustics.volume_frequency
        frequency = self._acoustics.choose_frequency(self._probe.frequencies)
        if own is None or frequency >= own:
            return imaging
        wavelength = SPEED_OF_SOUND * math.sqrt(1.0 / frequency**2 - 1.0 / own**2)
        return dataclasses.replace(
            imaging,
            lateral_resolution=min(math.hypot(imaging.lateral_resolution, 2.0 * wavelength), 0.01),
            axial_resolution=min(math.hypot(imaging.axial_resolution, 1.5 * wavelength), 0.01),
        )

    def warm_up(self) -> None:
        """Load every kernel, and find the volume's surfaces."""
        blank = np.zeros((self._probe.rows, self._probe.columns), dtype=np.uint8)
        self.apply_acoustics(blank, Frame(Pose(), None, self._probe, self._volume))

    def attach_mesh(self, rest_nodes: NDArray[np.float64], corners: NDArray[np.int32]) -> None:
        """Let a mesh carry the volume: (N, 3) m at rest and (M, 4)."""
        to_index = self._volume.patient_to_index
        self._rest_index = rest_nodes @ to_index[:3, :3].T + to_index[:3, 3]
        self._corners = np.ascontiguousarray(corners, dtype=np.int32)
        if self._fibres is not None:
            self._fibres.attach_mesh(rest_nodes, self._corners)

    def compute_gain(self, frame: Frame) -> NDArray[np.float32]:
        """Return (samples, beams) dB to add to the volume's echoes: time gain less all losses.

        It is overwritten by the next one.
        """
        grid, fibre = self.grid, self._no_fibres
        self._at = located, nodes = self._located(frame)
        self._elements[:, : located.elements.shape[1]] = located.elements
        if self._fibres is not None:
            fibre = self._fibres.compute_directions(located, nodes, frame.plane)
        self._found, first = trace_beams(
            self._elements.reshape(-1), self._elements.shape[1], self._steps, located.maps,
            self._voxels, self._shape, self._places, self._lines, self._across, self._along,
            self._media, self._time_gain, fibre,
            self._gain, self._blocked, self._blocker, self._crossings,
        )  # fmt: skip
        sharpen_edges(
            self._elements.reshape(-1), self._elements.shape[1], self._steps, located.maps,
            self._voxels, self._shape, self._lines, self._media, grid.samples, grid.beams,
            self._blocked, self._blocker,
        )  # fmt: skip
        cast_shadows(
            first, grid.beams, self._blocked, self._blocker, grid.distance, grid.aperture,
            grid.spacing, AMPLITUDES, self._gain,
        )  # fmt: skip
        return self._gain[:, : grid.beams]

    def apply_acoustics(self, image: NDArray[np.uint8], frame: Frame) -> NDArray[np.uint8]:
        """Return a slice of echoes (rows, columns) as the frame's beams bring them."""
        gain = self.compute_pixel_gain(frame)
        out = np.empty_like(image)
        _add_gain(image, gain, np.float32(GREYS_PER_DECIBEL), self._dither, out)
        if self._acoustics.surfaces:
            self._draw(frame, out)
        if self._noise is not None:
            np.maximum(out, self._noise.make_noise(frame.pose), out=out)
        return out

    def compute_pixel_gain(self, frame: Frame) -> NDArray[np.float32]:
        """Return (rows, columns) dB to add to the volume's echoes."""
        gain = self.grid.interpolate_to_pixels(self.compute_gain(frame))
        if self.grid.is_linear:
            sharpen_borders(
                self._found, self._crossings, self._gain, self._blocked, self._media, self._rise,
                np.array(self.grid.pixels), gain,
            )  # fmt: skip
        return gain

    def _located(self, frame: Frame) -> tuple[LocatedPixels, NDArray[np.float64]]:
        if frame.nodes is not None:
            return frame.locate_pixel_subset(LOCATED), frame.nodes
        plane, (row_step, step) = frame.plane, LOCATED
        shape = -(-plane.rows // row_step), -(-plane.columns // step)
        elements = np.zeros(shape, dtype=np.int32)
        maps = np.ascontiguousarray(compute_pixel_to_index(self._volume, plane)[None])
        return LocatedPixels(elements, maps, np.empty(0, dtype=np.intp)), np.empty((0, 3))

    @cached_property
    def _normals(self) -> SurfaceNormals:
        return find_surface_normals(self._volume)

    def _draw(self, frame: Frame, out: NDArray[np.uint8]) -> None:
        normals = self._normals
        grid, plane = self.grid, frame.plane
        located, nodes = self._at
        lateral, axial = self._probe.pixel_spacing
        axes = np.stack([plane.column_step / lateral, plane.row_step / axial])
        draw_surfaces(
            self._found, self._crossings, self._surface, normals.normals, normals.blocks,
            self._shape, self._rest_index, located.tetrahedra, self._corners, nodes, self._rigid,
            axes, grid.step, grid.spacing, grid.starts, grid.directions, lateral, axial,
            self._origin, self._pulse, GREYS_PER_DECIBEL, ANGLES, GRAIN, self._runs, out,
        )  # fmt: skip


def _apart(shape: tuple[int, int], kind: type[np.number]) -> NDArray[Any]:
    """Return zeros, padded in columns so that rows do not compete for the same lines of a cache."""
    lines = -(-shape[1] // 16) | 1  # of 64 bytes, an odd number
    return np.zeros((shape[0], 16 * lines), dtype=kind)


def _dither(columns: int) -> NDArray[np.float32]:
    """Return (8, columns) thresholds from 0 to 1, even along rows, that keep the mean grey."""
    row, column = np.arange(8)[:, None], np.arange(columns)[None, :]
    # Multiples of irrational numbers modulo 1 (Roberts, quasirandom sequences).
    return np.asarray((0.5 + 0.7548776662 * column + 0.5698402910 * row) % 1.0, dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_gain(image, gain, greys, dither, out):
    """Add gain (rows, columns) dB to grey levels (rows, columns); no echo stays none."""
    for row in range(image.shape[0]):
        line, add, result = image[row], gain[row], out[row]
        threshold = dither[row & 7]
        for i in range(len(line)):
            level = np.float32(line[i]) + add[i] * greys + threshold[i]
            level = min(max(level, np.float32(0.0)), np.float32(255.0))
            result[i] = np.uint8(np.int32(level)) if line[i] > 0 else np.uint8(0)


_FRAMES = 4
_GRAIN = (0.8, 1.4)  # standard deviations in pixels, along columns and rows


class ElectronicNoise:
    """Electronic noise of Rayleigh distribution, ``level`` dB at the face, rising by ``rise`` dB/m.

    It is another one from pose to pose, and the same whenever a pose is the same.
    """

    def __init__(self, probe: Probe, level: float, rise: float) -> None:
        distance = probe.pixel_beams[1]
        shown = np.isfinite(distance)
        mean = level + rise * np.nan_to_num(distance)
        random = np.random.Generator(np.random.PCG64(5))
        self._frames: list[NDArray[np.uint8]] = []
        for _ in range(_FRAMES):
            power = np.zeros(mean.shape, dtype=np.float32)
            for _ in range(2):  # in phase and in quadrature
                wave = random.standard_normal(mean.shape, dtype=np.float32)
                wave = np.asarray(cv2.GaussianBlur(wave, (0, 0), _GRAIN[0], sigmaY=_GRAIN[1]))
                power += wave * wave
            power /= power.mean()
            level = mean + 10.0 * np.log10(np.maximum(power, 1e-4)) + ECHO_RANGE
            grey = np.clip(level * GREYS_PER_DECIBEL, 0.0, 255.0)
            self._frames.append(np.where(shown, grey, 0.0).astype(np.uint8))

    def make_noise(self, pose: Pose) -> NDArray[np.uint8]:
        """Return (rows, columns) grey levels of noise with the probe at a pose."""
        bits = np.concatenate([pose.position, pose.orientation]).view(np.uint64)
        return self._frames[int(np.bitwise_xor.reduce(bits) % np.uint64(251)) % _FRAMES]


class Fibres:
    """The directions of fibres at rest, carried by a mesh: t = F t0 of the deformation gradient F.

    Args:
        directions: (D, 3) unit vectors in ``patient``.
    """

    def __init__(self, directions: NDArray[np.float64]) -> None:
        self._rest = directions
        self._weights = np.empty((0, len(directions), 4), dtype=np.float32)
        self._corners = np.empty((0, 4), dtype=np.int32)

    def attach_mesh(self, rest_nodes: NDArray[np.float64], corners: NDArray[np.int32]) -> None:
        """Let a mesh carry them: (N, 3) m at rest and (M, 4)."""
        edges = rest_nodes[corners[:, 1:]] - rest_nodes[corners[:, :1]]  # rows are edges
        determinant = np.linalg.det(edges)
        flat = np.abs(determinant) < 1e-30
        edges[flat] = np.eye(3)
        # Barycentric coordinates 1 to 3 along a direction: edges^T b = direction.
        along = np.linalg.solve(
            edges.transpose(0, 2, 1),
            np.broadcast_to(self._rest.T, (len(edges), *self._rest.T.shape)),
        )
        weights = np.empty((len(corners), len(self._rest), 4))
        weights[:, :, 1:] = along.transpose(0, 2, 1)
        weights[:, :, 0] = -weights[:, :, 1:].sum(axis=2)
        weights[flat] = 0.0
        self._weights, self._corners = weights.astype(np.float32), corners

    def compute_directions(
        self, located: LocatedPixels, nodes: NDArray[np.float64], plane: SlicePlane
    ) -> NDArray[np.float32]:
        """Return (E + 1, D, 2): x and z along the image of the unit direction in each map's tissue.

        Args:
            located: the maps, and the tetrahedra that they are of.
            nodes: (N, 3) m, where the mesh is now.
            plane: of the image.
        """
        across, down = (step / np.linalg.norm(step) for step in (plane.column_step, plane.row_step))
        out = np.empty((len(located.maps), len(self._rest), 2), dtype=np.float32)
        out[-1] = self._rest @ np.column_stack([across, down])  # tissue that is as at rest
        _carried(located.tetrahedra, self._corners, nodes, self._weights, across, down, out)
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def _carried(tetrahedra, corners, nodes, weights, across, down, out):
    for q in range(len(tetrahedra)):
        e = np.uint32(tetrahedra[q])
        for d in range(weights.shape[1]):
            x = y = z = 0.0
            for k in range(4):
                n = np.uint32(corners[e, k])
                w = np.float64(weights[e, d, k])
                x += w * nodes[n, 0]
                y += w * nodes[n, 1]
                z += w * nodes[n, 2]
            length = np.sqrt(x * x + y * y + z * z)
            scale = 1.0 / length if length > 0.0 else 0.0
            out[q, d, 0] = scale * (x * across[0] + y * across[1] + z * across[2])
            out[q, d, 1] = scale * (x * down[0] + y * down[1] + z * down[2])
