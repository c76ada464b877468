"""Markers: the shapes that nodes draw for RViz."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import rerun
from numpy.typing import NDArray

from us_sim.errors import MessageError, PoseError
from us_sim.geometry.pose import Pose
from us_sim.to_rerun.rerun_file import RerunFile

_DELETE, _DELETE_ALL = 2, 3
_ARROW, _CUBE, _SPHERE, _CYLINDER, _LINE_STRIP, _LINE_LIST = 0, 1, 2, 3, 4, 5
_CUBE_LIST, _SPHERE_LIST, _POINTS, _TEXT, _TRIANGLE_LIST = 6, 7, 8, 9, 11
"""Types and actions of visualization_msgs/Marker."""


class Markers:
    """``visualization_msgs/Marker`` and ``MarkerArray``: an entity for each namespace and number.

    A mesh that a marker only names by a file is refused.
    """

    def __init__(self) -> None:
        self._entities: dict[str, set[str]] = {}

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log what is drawn, and what is drawn no more."""
        known = self._entities.setdefault(entity, set())
        for marker in getattr(message, "markers", [message]):
            if marker.action == _DELETE_ALL:
                for one in sorted(known):
                    file.log(one, rerun.Clear(recursive=False))
                known.clear()
                continue
            one = _entity(entity, marker)
            if marker.action == _DELETE:
                file.log(one, rerun.Clear(recursive=False))
                known.discard(one)
                continue
            shape = _shape_of(marker)
            file.place(one, marker.header.frame_id)
            file.log(one, shape)
            known.add(one)


def _entity(entity: str, marker: Any) -> str:
    """Where a marker is logged: its number is left out where it is the first."""
    name = "/".join(part for part in marker.ns.split("/") if part)
    return "/".join(filter(None, [entity, name, str(marker.id) if marker.id else ""]))


def _shape_of(marker: Any) -> Any:
    """What rerun draws.

    Raises:
        MessageError: the type is another one, or a number is not finite.
    """
    draw = _SHAPES.get(marker.type)
    if draw is None:
        raise MessageError(f"a marker in namespace '{marker.ns}' is of type {marker.type}")
    p, q = marker.pose.position, marker.pose.orientation
    turn = (q.x, q.y, q.z, q.w)
    if not any(turn):  # as of a message in which nobody set it
        turn = (0.0, 0.0, 0.0, 1.0)
    try:
        pose = Pose(np.array([p.x, p.y, p.z]), np.array(turn))
    except PoseError as error:
        raise MessageError(f"a marker in namespace '{marker.ns}': {error}") from None
    points = np.array([(each.x, each.y, each.z) for each in marker.points]).reshape(-1, 3)
    scale = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    if not (np.isfinite(points).all() and np.isfinite(scale).all()):
        raise MessageError(f"a marker in namespace '{marker.ns}' has a number that is not finite")
    return draw(marker, pose, pose.apply(points), scale)


def _colours(marker: Any) -> NDArray[np.uint8]:
    """(K, 4) red, green, blue and opacity, 0 to 255: of each point, or of all."""
    given = [(c.r, c.g, c.b, c.a) for c in (marker.colors or [marker.color])]
    return np.asarray(np.nan_to_num(255 * np.clip(given, 0.0, 1.0)), dtype=np.uint8)


def _arrow(marker: Any, pose: Pose, points: NDArray[np.float64], scale: NDArray[np.float64]) -> Any:
    """From the first point to the second, or as long as the scale says along x."""
    if len(points) >= 2:
        origin, vector, radius = points[0], points[1] - points[0], scale[0] / 2
    else:
        origin, vector = pose.position, scale[0] * pose.rotation[:, 0]
        radius = scale[1] / 2
    return rerun.Arrows3D(
        origins=[origin], vectors=[vector], radii=radius, colors=_colours(marker)[0]
    )


def _solids(
    draw: Callable[..., Any],
    marker: Any,
    pose: Pose,
    points: NDArray[np.float64],
    scale: NDArray[np.float64],
) -> Any:
    """Boxes or ellipsoids of one size: one at the marker's pose, or of a list one at each point."""
    centres = points if marker.type in (_CUBE_LIST, _SPHERE_LIST) else [pose.position]
    return draw(
        centers=centres,
        half_sizes=[scale / 2] * len(centres),
        quaternions=[rerun.Quaternion(xyzw=pose.orientation)] * len(centres),
        colors=_colours(marker),
        fill_mode="solid",
    )


def _cylinder(marker: Any, pose: Pose, _: NDArray[np.float64], scale: NDArray[np.float64]) -> Any:
    return rerun.Cylinders3D(
        centers=[pose.position],
        lengths=[scale[2]],
        radii=[(scale[0] + scale[1]) / 4],
        quaternions=[rerun.Quaternion(xyzw=pose.orientation)],
        colors=_colours(marker)[:1],
        fill_mode="solid",
    )


def _lines(marker: Any, _: Pose, points: NDArray[np.float64], scale: NDArray[np.float64]) -> Any:
    if marker.type == _LINE_STRIP:
        strips, colours = [points], _colours(marker)[:1]
    else:
        whole = points[: len(points) // 2 * 2].reshape(-1, 2, 3)
        strips, colours = list(whole), _colours(marker)[:: 2 if marker.colors else 1]
    return rerun.LineStrips3D(strips, radii=scale[0] / 2, colors=colours)


def _points(marker: Any, _: Pose, points: NDArray[np.float64], scale: NDArray[np.float64]) -> Any:
    return rerun.Points3D(points, radii=scale[0] / 2, colors=_colours(marker))


def _text(marker: Any, pose: Pose, _: NDArray[np.float64], scale: NDArray[np.float64]) -> Any:
    return rerun.Points3D(
        [pose.position], radii=scale[2] / 10, colors=_colours(marker)[:1], labels=[marker.text]
    )


def _triangles(marker: Any, _: Pose, points: NDArray[np.float64], __: NDArray[np.float64]) -> Any:
    """Three corners a triangle; each with the normal of its triangle, so that it is shaded."""
    corners = points[: len(points) // 3 * 3].reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    each = _colours(marker)
    coloured = len(marker.colors) == len(points)
    return rerun.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        vertex_colors=each[: 3 * len(corners)] if coloured else None,
        albedo_factor=None if coloured else each[0],
    )


_SHAPES: dict[int, Callable[[Any, Pose, NDArray[np.float64], NDArray[np.float64]], Any]] = {
    _ARROW: _arrow,
    _CUBE: partial(_solids, rerun.Boxes3D),
    _CUBE_LIST: partial(_solids, rerun.Boxes3D),
    _SPHERE: partial(_solids, rerun.Ellipsoids3D),
    _SPHERE_LIST: partial(_solids, rerun.Ellipsoids3D),
    _CYLINDER: _cylinder,
    _LINE_STRIP: _lines,
    _LINE_LIST: _lines,
    _POINTS: _points,
    _TEXT: _text,
    _TRIANGLE_LIST: _triangles,
}
