"""Messages of a session as entities of a rerun recording, and the views that the viewer opens."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import rerun
import rerun.blueprint as views
from numpy.typing import NDArray
from rerun.encodings import AbsoluteTimeRange

from us_sim.command.rerun import STAMP, RerunFile
from us_sim.errors import MeshError, MessageError, PoseError, VolumeError
from us_sim.geometry.pose import Pose
from us_sim.geometry.triangles import vertex_normals
from us_sim.recording.decoding import (
    affine_from,
    colour_pixels_from,
    field_from,
    mesh_from,
    pixels_from,
    tetrahedra_from,
    transform_from,
    vectors_from,
    wrench_from,
)
from us_sim.recording.reader import Bag
from us_sim.recording.repair import extract
from us_sim.scene.building import structures_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


class Shown(Protocol):
    """Logs messages of one type, each at the time that the file has been told."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log a message of the topic ``/entity``.

        Raises:
            UsSimError: the message cannot be used.
        """


class Texts:
    """``std_msgs/String``."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        file.log(entity, rerun.TextLog(message.data))


class Transforms:
    """``tf2_msgs/TFMessage``."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        for each in message.transforms:
            pose, child = transform_from(each), each.child_frame_id
            file.log(
                f"{entity}/{child}",
                rerun.Transform3D(
                    translation=pose.position,
                    quaternion=pose.orientation,
                    parent_frame=each.header.frame_id,
                    child_frame=child,
                ),
            )


_RADIUS = rerun.Radius.ui_points(1.5)
_COLOUR = (79, 179, 191)


class Clouds:
    """``sensor_msgs/PointCloud2``, as points that are as large from afar."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        file.place(entity, message.header.frame_id)
        file.log(entity, rerun.Points3D(vectors_from(message), radii=_RADIUS, colors=_COLOUR))


SKIN = "skin"  # its entity
_SKIN_COLOUR = (217, 166, 140, 90)


class Skin:
    """``skin/mesh`` and ``skin/nodes`` as one mesh that deforms."""

    def __init__(self) -> None:
        self._triangles: NDArray[np.int64] | None = None
        self._is_there = False

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Remember the triangles, or log where the vertices are."""
        if entity == f"{SKIN}/mesh":
            self._triangles = mesh_from(message)[1]
            return
        if self._triangles is None:
            raise MeshError("the skin's triangles on /skin/mesh are missing")
        vertices = vectors_from(message)
        if len(self._triangles) and self._triangles.max() >= len(vertices):
            raise MeshError(
                f"the skin has {len(vertices)} vertices, and a triangle of /skin/mesh names vertex "
                f"{self._triangles.max()}"
            )
        file.place(SKIN, message.header.frame_id)
        if not self._is_there:
            mesh = rerun.Mesh3D.from_fields(
                triangle_indices=self._triangles, albedo_factor=_SKIN_COLOUR
            )
            file.log(SKIN, mesh)
            self._is_there = True
        normals = vertex_normals(vertices, self._triangles)
        file.log(SKIN, rerun.Mesh3D.from_fields(vertex_positions=vertices, vertex_normals=normals))


REST, TETRAHEDRA = "/tissue/rest", "/tissue/tetrahedra"
STRUCTURES = "tissue/structures"  # the entity that holds one for each
_TRIANGLES = 6_000


class Structures:
    """The structures of the scene that is attached to a session.

    Args:
        bag: the session, with the tissue's mesh.
        progress: called with the fraction of the volume that is made, and what is being made.

    Raises:
        UsSimError: there is no scene attached, its volume cannot be read, or the mesh is none.
    """

    def __init__(self, bag: Bag, progress: Callable[[float, str], None]) -> None:
        self._shown = False
        self._made = []
        with tempfile.TemporaryDirectory() as folder:
            extract(bag.path, Path(folder))
            scene = load_scene(Path(folder, "scene.yaml"))
            if scene.structures:
                found = {
                    each.topic: bag.deserialize(each) for each in bag.messages([REST, TETRAHEDRA])
                }
                mesh = TetrahedralMesh(
                    vectors_from(found[REST], "patient"), tetrahedra_from(found[TETRAHEDRA])
                )
                volume = volume_of(scene, progress)
                self._made = list(structures_of(scene, volume, mesh, _TRIANGLES))

    def take(self, _: str, message: Any, file: RerunFile) -> None:
        nodes = vectors_from(message, "patient")
        for structure in self._made:
            entity = f"{STRUCTURES}/{structure.name}"
            if not self._shown:
                file.place(entity, "patient")
                colour = [round(255 * channel) for channel in structure.colour]
                triangles = structure.surface.triangles
                shape = rerun.Mesh3D.from_fields(triangle_indices=triangles, albedo_factor=colour)
                file.log(entity, shape)
            vertices, normals = structure.surface.deform(nodes)
            shape = rerun.Mesh3D.from_fields(vertex_positions=vertices, vertex_normals=normals)
            file.log(entity, shape)
        self._shown = True


FORCE = "force"  # what a topic's name is followed by in the entity of the curves
METRES_A_NEWTON = 0.002  # of the arrow's length
_ARROW_RADIUS = 0.0008  # m, of the arrow's shaft
_COLOURS = ((224, 108, 117), (152, 195, 121), (97, 175, 239))


class Wrenches:
    """``geometry_msgs/WrenchStamped``."""

    def __init__(self) -> None:
        self._named: set[str] = set()

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        force = wrench_from(message)[:3]
        file.place(entity, message.header.frame_id)
        arrow = METRES_A_NEWTON * force
        file.log(entity, rerun.Arrows3D(vectors=arrow, radii=_ARROW_RADIUS, colors=(255, 255, 255)))
        curves = f"{entity}/{FORCE}"
        if curves not in self._named:
            self._named.add(curves)
            names = ["x, N", "y, N", "z, N"]
            file.log(curves, rerun.SeriesLines(names=names, colors=_COLOURS), static=True)
        file.log(curves, rerun.Scalars(force))


CURVES = {"rate_hz": "rate", "latency_p50_ms": "latency", "residual": "residual"}
"""Keys of diagnostics, and what their curves are called."""
_LEVELS = (
    rerun.TextLogLevel.INFO,
    rerun.TextLogLevel.WARN,
    rerun.TextLogLevel.ERROR,
    rerun.TextLogLevel.WARN,
)


class Diagnostics:
    """``diagnostic_msgs/DiagnosticArray``: a curve for each node and key, a line at each change."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, str]] = {}

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        for status in message.status:
            node = status.name.strip("/") or "node"
            for item in status.values:
                if item.key in CURVES and (value := _number(item.value)) is not None:
                    file.log(f"{entity}/{CURVES[item.key]}/{node}", rerun.Scalars(value))
            level = int(status.level)
            if self._last.get(node) != (level, status.message):
                self._last[node] = level, status.message
                text = rerun.TextLog(
                    f"{node}: {status.message}", level=_LEVELS[min(max(level, 0), 3)]
                )
                file.log(f"{entity}/state/{node}", text)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


IMAGE = "ultrasound/image"
PLANE = "ultrasound/plane"  # entity of the image in three dimensions
_WHERE = "ultrasound/image_to_probe"
_FINEST = 256  # pixels across the texture in three dimensions, where the image itself is beside it


class Images:
    """``sensor_msgs/Image``, and ``ultrasound/image_to_probe``, which says where pixels are."""

    def __init__(self) -> None:
        self._to_probe: NDArray[np.float64] | None = None
        self._corners: tuple[Any, ...] = ()

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log an image, or remember where its pixels are."""
        if entity == _WHERE:
            self._to_probe = affine_from(message)
            return
        if message.encoding.startswith("32FC"):
            file.log(entity, rerun.Tensor(field_from(message)))
            return
        if message.encoding == "rgb8":
            file.log(entity, rerun.Image(colour_pixels_from(message)))
            return
        if message.encoding not in ("mono8", "8UC1"):
            raise VolumeError(f"an image is {message.encoding}: mono8, rgb8 and 32FC are shown")
        pixels = pixels_from(message)
        file.log(entity, rerun.Image(pixels))
        if entity == IMAGE and self._to_probe is not None:
            self._place(pixels, message.header.frame_id, self._to_probe, file)

    def _place(
        self,
        pixels: NDArray[np.uint8],
        frame: str,
        to_probe: NDArray[np.float64],
        file: RerunFile,
    ) -> None:
        """Log the image where it was cut: two triangles with the pixels as their texture."""
        file.place(PLANE, frame)
        rows, columns = pixels.shape
        where = rows, columns, to_probe.tobytes()
        if where != self._corners:
            self._corners = where
            # a pixel's middle is at whole numbers, so the image ends half a pixel beyond
            ends = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]]) - 0.5
            corners = ends @ to_probe[:3, :2].T + to_probe[:3, 3]
            file.log(
                PLANE,
                rerun.Mesh3D.from_fields(
                    vertex_positions=corners,
                    triangle_indices=[[0, 1, 2], [0, 2, 3]],
                    vertex_texcoords=[[0, 0], [1, 0], [1, 1], [0, 1]],
                ),
            )
        scale = min(1.0, _FINEST / max(rows, columns))
        size = max(1, round(columns * scale)), max(1, round(rows * scale))
        texture = np.repeat(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)[..., None], 3, 2)
        file.log(
            PLANE,
            rerun.Mesh3D.from_fields(
                albedo_texture_buffer=texture.tobytes(),
                albedo_texture_format=rerun.components.ImageFormat(
                    width=size[0], height=size[1], color_model="RGB", channel_datatype="U8"
                ),
            ),
        )


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
    """The shape of a marker for rerun.

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


_BACKGROUND = (14, 17, 19)
_FROM, _AT, _UP = (0.11, -0.16, -0.11), (0.0, 0.0, 0.012), (0.0, 0.0, -1.0)
"""Where the eye is, what it looks at, and what is up, in `patient`, m: +z is into the tissue."""
_TITLES = {
    "rate": "Rates, Hz",
    "latency": "Latency of the nodes, ms",
    "residual": "Residuals",
}


def blueprint_of(
    shown: Collection[str], images: Collection[str], frame: str, span: tuple[int, int] | None
) -> Any:
    """Views of the data that there are.

    Args:
        shown: entities of topics that have messages.
        images: those of them that are images.
        frame: that the scene is seen in.
        span: ns since 1970, from the first stamp of a pose to the last, which is played; None where
            there are none.
    """
    scene = views.Spatial3DView(
        origin="/",
        name="Scene",
        contents=["/**", *(f"- /{image}" for image in images), "- /diagnostics/**"],
        spatial_information=views.SpatialInformation(frame),
        background=_BACKGROUND,
        line_grid=False,
        eye_controls=views.EyeControls3D(position=_FROM, look_target=_AT, eye_up=_UP),
    )
    ordered = sorted(images, key=lambda image: (image != IMAGE, image))
    beside = [views.Spatial2DView(origin=image, name=image) for image in ordered]
    curves = []
    if "probe/wrench" in shown:
        curves.append(views.TimeSeriesView(origin="probe/wrench", name="Force on the probe, N"))
    if "diagnostics" in shown:
        curves += [
            views.TimeSeriesView(origin=f"diagnostics/{curve}", name=_TITLES[curve])
            for curve in CURVES.values()
        ]
        curves.append(views.TextLogView(origin="diagnostics/state", name="States"))
    right = []
    if beside:
        right.append(views.Tabs(*beside, active_tab=0))
    if curves:
        right.append(views.Tabs(*curves, active_tab=0))
    whole = views.Horizontal(scene, views.Vertical(*right, row_shares=[2, 1][: len(right)]))
    selection = None if span is None else AbsoluteTimeRange(*span)
    time = views.TimePanel(
        timeline=STAMP,
        time_selection=selection,
        loop_mode=None if span is None else "selection",
        state="collapsed",
    )
    return views.Blueprint(whole if right else scene, time, collapse_panels=True)
