"""The camera model of ROS' camera_info, a pinhole with a lens, and its YAML file.

>>> from us_sim.tracking.camera.model import CameraModel
>>> camera = CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]], [-0.2, 0, 0, 0, 0])
>>> pixels = camera.project_points(np.array([[0.1, 0.05, 0.5]]))
>>> pixels.round(2)
array([[438.8, 299.4]])
>>> camera.compute_rays(pixels).round(6)
array([[0.2, 0.1]])
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.settings.text_files import read_yaml

_OPENCVS = (4, 5, 8, 12, 14)  # k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]
DISTORTION_MODELS = {
    "plumb_bob": _OPENCVS,  # whose name drivers give to coefficients of the longer models, too
    "rational_polynomial": _OPENCVS,
    "equidistant": (4,),
}
"""ROS's names of the lens models, and how many coefficients each may have."""

_LARGEST = 1e9  # pixels, or a coefficient
_LARGEST_IMAGE = 32768
_UNDISTORTING = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
_STILL = np.zeros(3)
_ARRIVED = 1e-6  # pixels, between a pixel and where its ray is seen


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
    distortion_model: str = "plumb_bob"  # of OpenCV's coefficients, in its order; its fisheye's

    def __post_init__(self) -> None:
        matrix: NDArray[np.float64] = _numbers(self.matrix, "the camera matrix").ravel()
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
        if not np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
            raise TrackingError(
                f"the camera matrix {matrix.tolist()} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        model, distortion = self._check_distortion()
        for array in (matrix, distortion):
            array.flags.writeable = False
        object.__setattr__(self, "distortion_model", model)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)

    def _check_distortion(self) -> tuple[str, NDArray[np.float64]]:
        """Return the name and the coefficients of the lens model, as OpenCV has them."""
        distortion = _numbers(self.distortion, "the distortion").ravel()
        model = self.distortion_model or "plumb_bob"
        if model == "fisheye":  # as some drivers call it
            model = "equidistant"
        if distortion.size == 0 and model == "plumb_bob":
            distortion = np.zeros(5)
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
        return model, distortion

    def project_points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points (N, 3) m to pixels (N, 2); NaN for those not before the camera."""
        return self.linearise_projection(points, _STILL)[0]

    def linearise_projection(
        self, points: NDArray[np.float64], shift: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project shifted points, and differentiate by the shift and a rotation before it.

        Args:
            points: (N, 3) m, about the origin of the rotation.
            shift: (3,) m.

        Returns:
            Pixels (N, 2), NaN for points that are not before the camera, and their derivatives
            (2 N, 6): pixels/m by the shift, pixels/rad by the rotation about the camera's axes.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(points):
            return np.empty((0, 2)), np.empty((0, 6))
        camera: Any = points[:, None], _STILL, shift, self.matrix, self.distortion
        jacobian: Any
        if self._is_fisheye:
            found, jacobian = cv2.fisheye.projectPoints(*camera)
            slopes = jacobian[:, [11, 12, 13, 8, 9, 10]]  # after those to the camera's numbers
        else:
            found, jacobian = cv2.projectPoints(*camera)
            slopes = jacobian[:, [3, 4, 5, 0, 1, 2]]
        pixels: NDArray[np.float64] = np.asarray(found, dtype=np.float64).reshape(-1, 2)
        pixels[~(points[:, 2] + shift[2] > 1e-9)] = np.nan
        return pixels, slopes

    def compute_rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rays x / z and y / z (N, 2) through pixels (N, 2); NaN beyond the lens model."""
        pixels = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if not len(pixels):
            return np.empty((0, 2))
        # OpenCV 4 has a function of its own for criteria.
        undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        if self._is_fisheye:
            undistort = cv2.fisheye.undistortPoints
        more = {"R": None, "P": None, "criteria": _UNDISTORTING}
        found = undistort(pixels, self.matrix, self.distortion, **more)
        rays: NDArray[np.float64] = np.array(found, dtype=np.float64).reshape(-1, 2)
        again = self.project_points(np.column_stack([rays, np.ones(len(rays))]))
        rays[~(np.abs(again - pixels[:, 0]).max(axis=1) < _ARRIVED)] = np.nan
        return rays

    @property
    def _is_fisheye(self) -> bool:
        return self.distortion_model == "equidistant"

    def require_image(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the image if it is one of this camera.

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
    if not (np.abs(numbers) <= _LARGEST).all():
        raise TrackingError(f"{what} is not finite, or far too large: {numbers.tolist()}")
    return numbers


def read_camera_info(path: Path | str) -> CameraModel:
    """Read the camera of a YAML file as ``camera_calibration`` or ``camera_info_manager`` write it.

    Raises:
        TrackingError: the file, or what it says, is not a camera's.
    """
    content = read_yaml(Path(path), TrackingError)
    if not isinstance(content, Mapping):
        raise TrackingError(f"{path}: not camera info; it must be a mapping")
    wanted = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
    for key in wanted:
        if key not in content:
            raise TrackingError(f"{path}: {key} is missing; camera info has {', '.join(wanted)}")
    model = content.get("distortion_model", "plumb_bob")
    width, height = sizes = [content[key] for key in wanted[:2]]
    if not all(isinstance(size, int) and not isinstance(size, bool) for size in sizes):
        raise TrackingError(f"{path}: image_width and image_height must be whole, not {sizes}")
    try:
        matrix, distortion = (_data(content, key) for key in wanted[2:])
        return CameraModel(width, height, matrix, distortion, model)
    except TrackingError as error:
        raise TrackingError(f"{path}: {error}") from error


def write_camera_info(
    path: Path | str,
    camera: CameraModel,
    name: str = "camera",
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Write the file that `read_camera_info` and ROS's drivers read.

    The notes are further keys on the calibration, which readers pass over.

    Raises:
        TrackingError: the file exists.
    """
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
        with open(path, "x", encoding="utf-8") as file:
            yaml.safe_dump(content, file, sort_keys=False, default_flow_style=None, width=100)
    except FileExistsError:
        raise TrackingError(f"{path}: exists already; choose another name") from None


def _data(content: Mapping[str, Any], key: str) -> Any:
    """Return the numbers of ``{rows, cols, data}``."""
    matrix = content[key]
    if not isinstance(matrix, Mapping) or "data" not in matrix:
        raise TrackingError(f"{key} must be a mapping with rows, cols and data")
    return matrix["data"]


def _matrix(values: np.ndarray[Any, Any]) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": [float(value) for value in values.ravel()]}
