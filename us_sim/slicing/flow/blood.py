"""The blood of all vessels of a scene at the pixels of a frame, and why Doppler shows none."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.flow.vessel import Vessel
from us_sim.slicing.frame import Frame, Mesh
from us_sim.slicing.probe.probe import Probe
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


class PixelWindow:
    """Places in an image, and the directions of the beams there.

    Args:
        angles: rad, of the beams from the probe's z towards its x; of pixels (rows, columns) of the
            window, or of places (P,).
        places: (P, 2) column and row; None for the pixels of the window.
        corner: row and column of the window's first pixel.
    """

    def __init__(
        self,
        probe: Probe,
        angles: NDArray[Any],
        places: NDArray[np.float64] | None = None,
        corner: tuple[int, int] = (0, 0),
    ) -> None:
        if places is None:
            rows, columns = (
                np.arange(n) + first for n, first in zip(angles.shape, corner, strict=True)
            )
            places = np.stack(np.meshgrid(columns, rows), axis=-1)
        self.shape = places.shape[:-1]
        column, row = places.reshape(-1, 2).T.astype(np.float32)
        self.column, self.row = np.ascontiguousarray(column), np.ascontiguousarray(row)
        self.x = np.sin(angles).astype(np.float32).ravel()
        self.z = np.cos(angles).astype(np.float32).ravel()
        nearest = np.rint(self.row).astype(np.int32), np.rint(self.column).astype(np.int32)
        within = (nearest[0] >= 0) & (nearest[0] < probe.rows) & (nearest[1] >= 0)
        within &= nearest[1] < probe.columns
        self.pixel = np.where(within, nearest[0] * probe.columns + nearest[1], -1).astype(np.int32)


class Blood:
    """The vessels of a scene that have a flow."""

    def __init__(self, vessels: Sequence[Vessel]) -> None:
        self.vessels = tuple(vessels)
        self._frame: Frame | None = None
        self._mesh: Mesh | None = None

    def advance_to_frame(self, frame: Frame) -> Blood:
        """Advance all vessels to a frame, once for all callers; return self.

        Raises:
            MeshError: the frame's mesh cannot carry anything.
        """
        if frame is not self._frame:
            if frame.mesh is not self._mesh:
                mesh = None if frame.mesh is None else TetrahedralMesh(*frame.mesh)
                for vessel in self.vessels:
                    vessel.attach_mesh(mesh)
                self._mesh = frame.mesh
            for vessel in self.vessels:
                vessel.advance_to(frame.time, frame.nodes)
            self._frame = frame
        return self

    def compute_velocity(self, frame: Frame, window: PixelWindow) -> NDArray[np.float32]:
        """Return m/s along beams towards the probe at the window's places; NaN outside lumens."""
        factors = [float(vessel.evaluate_pulse(frame.time)) for vessel in self.vessels]
        return self._compute_velocity(frame, window, factors)[0]

    def compute_mean_velocities(
        self, frame: Frame, window: PixelWindow
    ) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Return velocities averaged over the pulse, and the vessel of each place, -1 for none."""
        return self._compute_velocity(frame, window, [1.0] * len(self.vessels))

    def _compute_velocity(
        self, frame: Frame, window: PixelWindow, factors: Sequence[float]
    ) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        self.advance_to_frame(frame)
        located = frame.placed
        velocity = np.full(len(window.pixel), np.nan, dtype=np.float32)
        which = np.full(len(window.pixel), -1, dtype=np.int8)
        in_image = frame.pose.rotation[:, [0, 2]]
        for number, (vessel, factor) in enumerate(zip(self.vessels, factors, strict=True)):
            # Beams lead away from the probe.
            axis = np.ascontiguousarray(vessel.axis_velocity @ in_image * -factor)
            _find_velocity(
                located.elements.reshape(-1), located.maps, window.pixel, window.column, window.row,
                window.x, window.z, vessel.map.corner, vessel.map.station, vessel.map.offset, axis,
                np.int8(number), velocity, which,
            )  # fmt: skip
        return velocity.reshape(window.shape), which.reshape(window.shape)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_velocity(  # noqa: PLR0913
    elements, maps, pixel, columns, rows, beam_x, beam_z, corner, station, offset, axis, number,
    velocity, which,
):  # fmt: skip
    """Write velocity (P,) and which (P,) of places in a vessel's lumen.

    Shapes and units:
        elements: of all pixels. maps: (E, 3, 3) from (1, column, row) to voxel indices.
        pixel: (P,) number of the pixel at each place, -1 outside the image. columns, rows: (P,).
        beam_x, beam_z: (P,) the beams' directions. corner: (3,) voxels.
        station: (i, j, k). offset: (i, j, k, 2). axis: (S, 2) m/s along the probe's x and z.
    """
    last_i, last_j, last_k = station.shape[0] - 2, station.shape[1] - 2, station.shape[2] - 2
    most = len(axis) - 2
    for p in range(len(pixel)):
        if pixel[p] < 0:
            continue
        e = elements[pixel[p]]
        if e < 0:
            continue
        column, row = np.float64(columns[p]), np.float64(rows[p])
        u = maps[e, 0, 0] + maps[e, 0, 1] * column + maps[e, 0, 2] * row - corner[0]
        if not 0.0 <= u <= last_i + 1:
            continue
        v = maps[e, 1, 0] + maps[e, 1, 1] * column + maps[e, 1, 2] * row - corner[1]
        w = maps[e, 2, 0] + maps[e, 2, 1] * column + maps[e, 2, 2] * row - corner[2]
        if not (0.0 <= v <= last_j + 1 and 0.0 <= w <= last_k + 1):
            continue
        i, j, k = min(np.int64(u), last_i), min(np.int64(v), last_j), min(np.int64(w), last_k)
        across = _interpolate(offset[..., 0], i, j, k, u - i, v - j, w - k)
        down = _interpolate(offset[..., 1], i, j, k, u - i, v - j, w - k)
        r = across * across + down * down
        if not r < 1.0:
            continue
        s = _interpolate(station, i, j, k, u - i, v - j, w - k)
        at = np.int64(min(s, np.float64(most)))
        part = s - at
        along_x = axis[at, 0] * (1.0 - part) + axis[at + 1, 0] * part
        along_z = axis[at, 1] * (1.0 - part) + axis[at + 1, 1] * part
        velocity[p] = (1.0 - r) * (along_x * beam_x[p] + along_z * beam_z[p])
        which[p] = number


@njit(inline="always", error_model="numpy")
def _interpolate(grid, i, j, k, u, v, w):
    c0 = (grid[i, j, k] * (1.0 - w) + grid[i, j, k + 1] * w) * (1.0 - v) + (
        grid[i, j + 1, k] * (1.0 - w) + grid[i, j + 1, k + 1] * w
    ) * v
    c1 = (grid[i + 1, j, k] * (1.0 - w) + grid[i + 1, j, k + 1] * w) * (1.0 - v) + (
        grid[i + 1, j + 1, k] * (1.0 - w) + grid[i + 1, j + 1, k + 1] * w
    ) * v
    return c0 * (1.0 - u) + c1 * u


_HEARD = 0.3  # coupling below which blood, 20 dB fainter than tissue, is lost
_STANDING = 1e-3  # m/s on a vessel's axis
_ACROSS = 0.12  # cosine between beam and flow: 83 degrees


class FlowAbsence(Enum):
    """Reasons why no flow is seen in a part of the image; NOTHING where it should be seen."""

    NOTHING = ""
    NO_CONTACT = "no_contact"  # the beams there have no contact, or too little
    NO_VESSEL = "no_vessel"  # no lumen with a flow is there
    NO_FLOW = "no_flow"  # the vessel is closed
    ACROSS_FLOW = "across_flow"  # the beams are square to it
    TOO_SLOW = "too_slow"  # for the wall filter


def explain_absence(
    blood: Blood, frame: Frame, window: PixelWindow, lines: NDArray[np.integer], wall_filter: float
) -> FlowAbsence:
    """Explain why flow cannot be seen at the places of a window.

    Args:
        blood: the vessels.
        frame: the image.
        window: where in it.
        lines: of the probe, as many as places in the window, whose echoes come from there.
        wall_filter: m/s.
    """
    coupling = np.ones(1) if frame.contact is None else frame.contact[0]
    heard = coupling[np.minimum(lines.ravel(), len(coupling) - 1)]
    if heard.max(initial=0.0) < _HEARD:
        return FlowAbsence.NO_CONTACT
    velocity, which = (each.ravel() for each in blood.compute_mean_velocities(frame, window))
    within = which >= 0
    if not within.any():
        return FlowAbsence.NO_VESSEL
    if heard[within].max() < _HEARD:
        return FlowAbsence.NO_CONTACT
    cosine = fastest = speed = 0.0
    for number in np.unique(which[within]):
        vessel = blood.vessels[number]
        axis = float(np.linalg.norm(vessel.axis_velocity, axis=1).mean())
        along = float(np.abs(velocity[which == number]).max())
        speed = max(speed, axis)
        cosine = max(cosine, along / axis if axis > _STANDING else 0.0)
        # On the axis blood flows twice as fast as in the mean.
        peak = 0.5 * vessel.settings.peak_velocity / vessel.settings.mean_velocity
        fastest = max(fastest, along * peak)
    if speed < _STANDING:
        return FlowAbsence.NO_FLOW
    if cosine < _ACROSS:
        return FlowAbsence.ACROSS_FLOW
    return FlowAbsence.TOO_SLOW if fastest < wall_filter else FlowAbsence.NOTHING
