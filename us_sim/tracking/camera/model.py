"""The camera model of ROS' camera_info, a pinhole with a lens, and its YAML file.

>>> from us_sim.tracking.camera.model import CameraModel
>>> camera = CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]], [-0.2, 0, 0, 0, 0])
>>> pixels = camera.project(np.array([[0.1, 0.05, 0.5]]))
>>> pixels.round(2)
array([[438.8, 299.4]])
>>> camera.rays(pixels).round(6)
array([[0.2, 0.1]])
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.kernels import njit
from us_sim.settings.text_files import YamlError, load_yaml, read_text

DISTORTION_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
"""ROS's names of the lens models, and how many coefficients each has."""

_LARGEST_IMAGE = 32768
_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera: size of its images, pinhole and lens distortion.

    Pixel (0, 0) is the centre of the upper left pixel. Points are in frame ``camera_optical``:
    z forward, x right, y down.

    Raises:
        TrackingError: it is no camera: sizes, focal lengths or coefficients are impossible.
    """

    width: int  # pixels
    height: int  # pixels
    matrix: NDArray[np.float64]  # (3, 3) pixels: focal lengths and principal point
    distortion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(5))  # (n,)
    distortion_model: str = "plumb_bob"  # of OpenCV's coefficients, in its order

    def __post_init__(self) -> None:
        matrix: NDArray[np.float64] = _numbers(self.matrix, "the camera matrix").ravel()
        distortion = _numbers(self.distortion, "the distortion").ravel()
        if matrix.size != 9:
            raise TrackingError(f"the camera matrix has {matrix.size} numbers; it needs 3 × 3")
        matrix = matrix.reshape(3, 3)
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise TrackingError(
                "the camera is not calibrated: its focal length is zero; calibrate it with "
                "us-sim calibrate camera"
            )
        for name, size in (("width", self.width), ("height", self.height)):
            if size != int(size) or not 0 < size <= _LARGEST_IMAGE:
                raise TrackingError(
                    f"the camera's image {name} is {size}: it must be 1 to {_LARGEST_IMAGE} pixels"
                )
            object.__setattr__(self, name, int(size))
        if not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0.0, 0.0, 0.0, 1.0]):
            raise TrackingError(
                f"the camera matrix {matrix.tolist()} must be [[fx, skew, cx], [0, fy, cy], "
                f"[0, 0, 1]]"
            )
        model = self.distortion_model
        if distortion.size == 0 and model in ("", "plumb_bob"):
            model, distortion = "plumb_bob", np.zeros(5)
        if model not in DISTORTION_MODELS:
            raise TrackingError(
                f"the camera's distortion model '{model}' is not known; it must be "
                f"{', '.join(DISTORTION_MODELS)}"
            )
        if distortion.size not in DISTORTION_MODELS[model]:
            counts = " or ".join(str(count) for count in DISTORTION_MODELS[model])
            raise TrackingError(
                f"the camera's distortion has {distortion.size} coefficients; {model} has {counts}"
            )
        for array in (matrix, distortion):
            array.flags.writeable = False
        object.__setattr__(self, "distortion_model", model)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)

    @cached_property
    def lens(self) -> tuple[NDArray[np.float64], bool]:
        """For `project_points`: (13,) fx, fy, cx, cy, skew and eight coefficients; whether they are
        a fisheye's.
        """
        numbers = np.zeros(13)
        matrix = self.matrix
        numbers[:5] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[0, 1]
        numbers[5 : 5 + self.distortion.size] = self.distortion
        return numbers, self.distortion_model == "equidistant"

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of points (N, 3) m; NaN for points that are not before the camera."""
        return self.linearise(points)[0]

    def linearise(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (N, 2) of points (N, 3) m, and their derivative (N, 2, 3) pixels/m."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        pixels = np.empty((len(points), 2))
        slopes = np.empty((len(points), 2, 3))
        project_points(points, *self.lens, pixels, slopes)
        return pixels, slopes

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rays x / z and y / z (N, 2) through pixels (N, 2); NaN where the lens model has
        no such point.
        """
        pixels = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
        rays = np.empty((len(pixels), 2))
        _undistort(pixels, *self.lens, rays)
        return rays

    def require_image(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """The image, which is one of this camera.

        Raises:
            TrackingError: it is not grey, or not of the camera's size.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise TrackingError(
                f"the camera's image is {image.dtype} {image.shape}; it must be grey uint8 "
                f"(rows, columns)"
            )
        if image.shape != (self.height, self.width):
            raise TrackingError(
                f"the image has {image.shape[1]} × {image.shape[0]} pixels, but the camera info "
                f"is of {self.width} × {self.height}: calibrate the camera at the size it runs at"
            )
        return np.ascontiguousarray(image)


def _numbers(values: Any, what: str) -> NDArray[np.float64]:
    try:
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise TrackingError(f"{what} must be numbers, not {values!r}") from None
    if not np.isfinite(numbers).all():
        raise TrackingError(f"{what} is not finite: {numbers.tolist()}")
    return numbers


@njit(cache=True, nogil=True, error_model="numpy")
def _distort(x, y, lens, fisheye):
    """Where the lens shows x / z, y / z, and the four derivatives of that.

    OpenCV's models: radial rational with tangential terms, and the fisheye's polynomial of the
    angle (Kannala and Brandt 2006).
    """
    k1, k2, k3, k4 = lens[5], lens[6], lens[7], lens[8]
    square = x * x + y * y
    if fisheye:
        radius = np.sqrt(square)
        if radius < 1e-9:
            return x, y, 1.0, 0.0, 0.0, 1.0
        angle = np.arctan(radius)
        a = angle * angle
        bent = angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
        slope = 1 + a * (3 * k1 + a * (5 * k2 + a * (7 * k3 + a * 9 * k4)))
        scale = bent / radius
        # d(scale)/d(radius) / radius
        change = (slope / (1 + square) - scale) / square
        return (
            scale * x,
            scale * y,
            scale + change * x * x,
            change * x * y,
            change * x * y,
            scale + change * y * y,
        )
    # Of plumb_bob and rational: k1, k2, p1, p2, k3, and the denominator's three.
    p1, p2, k3, k4, k5, k6 = lens[7], lens[8], lens[9], lens[10], lens[11], lens[12]
    over = 1 + square * (k1 + square * (k2 + square * k3))
    under = 1 + square * (k4 + square * (k5 + square * k6))
    scale = over / under
    slope = k1 + square * (2 * k2 + square * 3 * k3)
    slope -= scale * (k4 + square * (2 * k5 + square * 3 * k6))
    slope *= 2 / under
    return (
        scale * x + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        scale * y + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        scale + slope * x * x + 2 * p1 * y + 6 * p2 * x,
        slope * x * y + 2 * p1 * x + 2 * p2 * y,
        slope * x * y + 2 * p1 * x + 2 * p2 * y,
        scale + slope * y * y + 6 * p1 * y + 2 * p2 * x,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def project_points(points, lens, fisheye, pixels, slopes):
    """Fill in pixels (N, 2) and their derivatives (N, 2, 3) of points (N, 3).

    Args:
        points: m, in front of the camera; pixels of others are NaN.
        lens, fisheye: `CameraModel.lens`.
        pixels, slopes: what is filled in.
    """
    fx, fy, cx, cy, skew = lens[0], lens[1], lens[2], lens[3], lens[4]
    for i in range(len(points)):
        depth = points[i, 2]
        if not depth > 1e-9:
            pixels[i] = np.nan
            slopes[i] = np.nan
            continue
        x, y = points[i, 0] / depth, points[i, 1] / depth
        u, v, ux, uy, vx, vy = _distort(x, y, lens, fisheye)
        pixels[i, 0] = fx * u + skew * v + cx
        pixels[i, 1] = fy * v + cy
        slopes[i, 0, 0] = (fx * ux + skew * vx) / depth
        slopes[i, 0, 1] = (fx * uy + skew * vy) / depth
        slopes[i, 1, 0] = fy * vx / depth
        slopes[i, 1, 1] = fy * vy / depth
        slopes[i, 0, 2] = -x * slopes[i, 0, 0] - y * slopes[i, 0, 1]
        slopes[i, 1, 2] = -x * slopes[i, 1, 0] - y * slopes[i, 1, 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _undistort(pixels, lens, fisheye, rays):
    """Inverts `project_points` by Newton's method; NaN where it does not arrive."""
    fx, fy, cx, cy, skew = lens[0], lens[1], lens[2], lens[3], lens[4]
    for i in range(len(pixels)):
        v = (pixels[i, 1] - cy) / fy
        u = (pixels[i, 0] - cx - skew * v) / fx
        x, y = u, v
        if fisheye:
            # A fisheye's pixel may lie well beyond a pinhole's: start at the plain angle.
            angle = np.sqrt(u * u + v * v)
            if angle > 1e-9:
                stretch = np.tan(min(angle, 1.5)) / angle
                x, y = u * stretch, v * stretch
        rays[i] = np.nan
        for _ in range(_ITERATIONS):
            a, b, ux, uy, vx, vy = _distort(x, y, lens, fisheye)
            a -= u
            b -= v
            determinant = ux * vy - uy * vx
            # A lens model folds back where its derivative is no longer positive: nothing there
            # is in the image.
            if not (determinant > 1e-9 and ux + vy > 0):
                break
            if a * a + b * b < 1e-24:
                rays[i, 0] = x
                rays[i, 1] = y
                break
            dx = (vy * a - uy * b) / determinant
            dy = (ux * b - vx * a) / determinant
            length = np.sqrt(dx * dx + dy * dy)
            limit = 0.5 * (1 + np.sqrt(x * x + y * y))
            if length > limit:
                dx *= limit / length
                dy *= limit / length
            x -= dx
            y -= dy


def read_camera_info(path: Path | str) -> CameraModel:
    """The camera of a YAML file as ``camera_calibration`` and ``camera_info_manager`` write it.

    Raises:
        TrackingError: the file, or what it says, is not a camera's.
    """
    path = Path(path)
    try:
        content = load_yaml(read_text(path))
    except OSError as error:
        raise TrackingError(f"{path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, YamlError) as error:
        raise TrackingError(
            f"{path}: not a YAML file of camera info: {str(error).splitlines()[0]}"
        ) from error
    if not isinstance(content, Mapping):
        raise TrackingError(f"{path}: not camera info; it must be a mapping")
    wanted = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
    for key in wanted:
        if key not in content:
            raise TrackingError(f"{path}: {key} is missing; camera info has {', '.join(wanted)}")
    model = content.get("distortion_model", "plumb_bob")
    sizes = [content[key] for key in wanted[:2]]
    if not all(isinstance(size, int) and not isinstance(size, bool) for size in sizes):
        raise TrackingError(f"{path}: image_width and image_height must be whole, not {sizes}")
    try:
        return CameraModel(
            sizes[0],
            sizes[1],
            _data(content, "camera_matrix"),
            _data(content, "distortion_coefficients"),
            model,
        )
    except TrackingError as error:
        raise TrackingError(f"{path}: {error}") from error


def write_camera_info(
    path: Path | str,
    camera: CameraModel,
    name: str = "camera",
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Write the file that `read_camera_info` and ROS's drivers read.

    The notes are further keys, which readers pass over: how it was calibrated, and how well.

    Raises:
        TrackingError: the file exists.
    """
    path = Path(path)
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    content: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(camera.matrix),
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": _matrix(camera.distortion[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(projection),
        **(notes or {}),
    }
    try:
        with path.open("x", encoding="utf-8") as file:
            yaml.safe_dump(content, file, sort_keys=False, default_flow_style=None, width=100)
    except FileExistsError:
        raise TrackingError(f"{path}: exists already; choose another name") from None


def _data(content: Mapping[str, Any], key: str) -> Any:
    """The numbers of ``{rows, cols, data}``."""
    matrix = content[key]
    if not isinstance(matrix, Mapping) or "data" not in matrix:
        raise TrackingError(f"{key} must be a mapping with rows, cols and data")
    return matrix["data"]


def _matrix(values: np.ndarray[Any, Any]) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": [float(value) for value in values.ravel()]}
