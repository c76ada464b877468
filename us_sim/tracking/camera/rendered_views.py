"""Rendered images of a body of markers at a known pose, pixel by pixel.

>>> import cv2, numpy as np
>>> from us_sim.tracking.camera.rendered_views import SHARP, RenderedView
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.camera.model import CameraModel
>>> from us_sim.tracking.camera.source import CameraSource
>>> from us_sim.tracking.camera.rigid_body import RigidBody
>>> camera = CameraModel(320, 240, [[300, 0, 160], [0, 300, 120], [0, 0, 1]], [-0.2, 0, 0, 0, 0])
>>> marker = RigidBody.create_single("4X4_50", 7, 0.04)
>>> image = RenderedView(camera, marker).render(Pose([0.02, 0.0, 0.25], [1, 0.1, 0, 0]), SHARP)
>>> image.shape, image.dtype
((240, 320), dtype('uint8'))
>>> CameraSource(camera, marker).measure_pose(image, 0).pose.position.round(3) + 0.0
array([0.02, 0.  , 0.25])
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose, multiply_quaternions
from us_sim.geometry.se3 import rotation_exp
from us_sim.kernels import njit
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rigid_body import Print, RigidBody

_LENS = np.array([-0.2, 0.06, 6e-4, -4e-4, 0.0])
_SMALL = np.array([[600.0, 0.0, 322.3], [0.0, 601.0, 238.1], [0.0, 0.0, 1.0]])  # pixels
_LARGE = np.array([[1350.0, 0.0, 965.2], [0.0, 1352.0, 536.7], [0.0, 0.0, 1.0]])  # pixels
WEBCAMS = {
    "640x480": CameraModel(640, 480, _SMALL, _LENS),
    "1920x1080": CameraModel(1920, 1080, _LARGE, 0.3 * _LENS),
}
"""Cameras to render for, by the size of their images; both see 44° from top to bottom."""

_BLACK, _WHITE = 26.0, 225.0  # grey, of print in full light
_AMBIENT = 0.35  # of the light, which comes from everywhere
_LIGHT = np.array([0.3, -0.5, -0.8]) / math.sqrt(0.98)  # unit, from the scene towards the lamp
_SKIN = 150.0  # grey
_SAMPLES = 8  # a side, of the rays through a pixel that an edge crosses
_STEP = 0.5  # pixels that a body moves between the moments of which an exposure is summed


@dataclass(frozen=True)
class Conditions:
    """Noise, blur and light that degrade the image of a body."""

    defocus: float = 0.6  # pixels, standard deviation of the lens's blur
    read_noise: float = 1.0  # grey, standard deviation of what every pixel adds
    shot_noise: float = 0.01  # grey, variance that comes with each level of light
    gradient: float = 0.0  # fraction of the light that is lost from one side to the other
    occlusion: float = 0.0  # fraction of the body's extent in the image that a hand covers


SHARP = Conditions(defocus=0.0, read_noise=0.0, shot_noise=0.0)
"""An image that is only sampled to pixels and grey levels."""


class RenderedView:
    """A camera before a background, in which a body can be put anywhere.

    Every pixel that the edge of a cell of a marker crosses is the mean of 64 rays through the lens;
    then come the lens's blur, the light, and the sensor's noise and grey levels. The same arguments
    give the same bytes.

    Args:
        camera: of the view.
        body: in the view. Sheets of paper around its markers are white.
        seed: of the background.
    """

    def __init__(self, camera: CameraModel, body: RigidBody, seed: int = 0) -> None:
        self.camera = camera
        self.body = body
        self._sheets = _sheets(body)
        columns, rows = np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        self._rays = camera.compute_rays(grid).reshape(camera.height + 1, camera.width + 1, 2)
        self._background = _background(camera, np.random.default_rng(seed))

    def render(
        self,
        pose: Pose,
        conditions: Conditions | None = None,
        seed: int = 0,
        motion: NDArray[np.float64] | None = None,
        frame: int = 0,
    ) -> NDArray[np.uint8]:
        """Render the image (rows, columns), grey.

        Args:
            pose: of the body in ``camera_optical``, in the middle of the exposure.
            conditions: that degrade the image.
            seed: of the hand and the light's direction, and with the frame of the noise.
            motion: (6,) m and rad, shift and rotation about the camera's axes from the beginning
                to the end of the exposure.
            frame: of a sequence in which the hand and the light stay as they are.
        """
        conditions = conditions or Conditions()
        random = np.random.default_rng(seed)
        light = np.empty_like(self._background)
        moments = self._moments(pose, motion)
        for number, moment in enumerate(moments):
            image = self._background.copy()
            self._draw(image, moment)
            light = image if number == 0 else light + image
        if len(moments) > 1:
            light /= len(moments)
        if conditions.occlusion > 0:
            self._draw_hand(light, pose, conditions.occlusion, random)
        if conditions.defocus > 0:
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), conditions.defocus))
        if conditions.gradient > 0:
            light *= self._gradient(conditions.gradient, random)
        noise = np.random.default_rng([seed, frame]).standard_normal(light.shape, np.float32)
        image8 = np.empty(light.shape, dtype=np.uint8)
        read, shot = float(conditions.read_noise) ** 2, float(conditions.shot_noise)
        _expose(light, noise, read, shot, image8)
        return image8

    def _moments(self, pose: Pose, motion: NDArray[np.float64] | None) -> list[Pose]:
        """Return poses during the exposure, so close that their sum is smooth."""
        if motion is None:
            return [pose]
        ends = [_moved(pose, fraction * motion) for fraction in (-0.5, 0.5)]
        corners = self.body.corners.reshape(-1, 3)
        first, last = (self.camera.project_points(end.transform_points(corners)) for end in ends)
        shift = np.linalg.norm(last - first, axis=1)
        longest = float(shift.max()) if np.isfinite(shift).all() else 0.0
        count = max(1, math.ceil(longest / _STEP))
        return [_moved(pose, ((i + 0.5) / count - 0.5) * motion) for i in range(count)]

    def _draw(self, image: NDArray[np.float32], pose: Pose) -> None:
        """Print the sheets that face the camera, one over the other in their order."""
        turn = pose.rotation
        for sheet in self._sheets:
            corners = pose.transform_points(sheet.corners)
            along, down = turn @ sheet.along, turn @ sheet.down
            normal = np.cross(down, along)
            if normal @ corners[0] >= 0 or corners[:, 2].min() <= 1e-3:
                continue
            pixels = self.camera.project_points(corners)
            if not np.isfinite(pixels).all():
                continue
            # The lens bends edges, outwards by less than the sheet's own size.
            margin = 2 + 0.05 * float(np.ptp(pixels, axis=0).max())
            size = [self.camera.width, self.camera.height]
            low = np.clip(np.floor(pixels.min(axis=0) - margin), 0, size).astype(np.int64)
            high = np.clip(np.ceil(pixels.max(axis=0) + margin), 0, size).astype(np.int64)
            if (high <= low).any():
                continue
            towards = float(normal @ _LIGHT) / float(np.linalg.norm(normal))
            shade = _AMBIENT + (1 - _AMBIENT) * max(0.0, towards)
            inverse = np.linalg.inv(np.column_stack([along, down, corners[0]]))
            window = (slice(low[1], high[1] + 1), slice(low[0], high[0] + 1))
            _print(
                image[low[1] : high[1], low[0] : high[0]],
                self._rays[window],
                inverse,
                sheet.cells,
                np.float32(shade * _BLACK),
                np.float32(shade * _WHITE),
            )

    def _draw_hand(
        self, image: NDArray[np.float32], pose: Pose, fraction: float, random: np.random.Generator
    ) -> None:
        """Draw fingers that come from one side and cover a fraction of the body's extent."""
        corners = self.camera.project_points(
            pose.transform_points(self.body.corners.reshape(-1, 3))
        )
        if not np.isfinite(corners).all():
            return
        angle = random.uniform(0, 2 * np.pi)
        reach = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-reach[1], reach[0]])
        heights, widths = corners @ reach, corners @ across
        tip = heights.min() + fraction * np.ptp(heights)
        finger = max(4.0, float(np.ptp(widths)) / 3.2)
        start = float(widths.min()) + random.uniform(-0.3, 0.3) * finger
        far = float(np.hypot(*image.shape))
        for number in range(4):
            # The tips lie on an arc, a little apart from each other, with dark gaps between.
            end = tip - finger * (0.5 + 0.35 * abs(number - 1.3)) + random.uniform(-2, 2)
            side = start + finger * (number + 0.5)
            for width, grey in ((1.0, 0.6 * _SKIN), (0.85, _SKIN)):
                ends = (end * reach + side * across, (end - far) * reach + side * across)
                one, other = (tuple(round(16 * float(n)) for n in point) for point in ends)
                thickness = max(1, int(width * finger))
                cv2.line(image, one, other, grey, thickness, lineType=cv2.LINE_8, shift=4)

    def _gradient(self, loss: float, random: np.random.Generator) -> NDArray[np.float32]:
        """Return the light (rows, columns), 1 at one side of the image."""
        angle = random.uniform(0, 2 * np.pi)
        width, height = self.camera.width, self.camera.height
        x = (np.arange(width, dtype=np.float32) / width - 0.5) * np.float32(np.cos(angle))
        y = (np.arange(height, dtype=np.float32) / height - 0.5) * np.float32(np.sin(angle))
        extent = 0.5 * (abs(np.cos(angle)) + abs(np.sin(angle)))
        slope = np.float32(0.5 * loss / extent)
        return np.asarray(1 - 0.5 * loss + slope * (x[None] + y[:, None]), dtype=np.float32)


def _moved(pose: Pose, motion: NDArray[np.float64]) -> Pose:
    """Shift a pose, and turn it about its own origin, both along the camera's axes."""
    turned = multiply_quaternions(rotation_exp(motion[3:]), pose.orientation)
    return Pose(pose.position + motion[:3], turned)


_BLANK = np.ones((1, 1), dtype=np.bool_)


def _sheets(body: RigidBody) -> list[Print]:
    """Yield white paper first, then the print on it."""
    if body.chessboard is not None:
        print_ = body.prints[0]
        a, b = (0.5 * body.chessboard.square * axis for axis in np.eye(3)[:2])
        paper = Print(-a - b, print_.along + 2 * a, print_.down + 2 * b, _BLANK)
        return [paper, *body.prints]
    cells = len(body.prints[0].cells)
    papers: list[Print] = []
    for each in body.prints:
        a, b = each.along / cells, each.down / cells
        papers.append(Print(each.origin - a - b, each.along + 2 * a, each.down + 2 * b, _BLANK))
    return [*papers, *body.prints]


def _background(camera: CameraModel, random: np.random.Generator) -> NDArray[np.float32]:
    """Draw a room out of focus, with things in it that have edges."""
    size = (camera.width, camera.height)
    coarse = random.uniform(50, 170, (9, 12)).astype(np.float32)
    room = np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)
    for _ in range(14):
        middle = random.uniform(0, 1, 2) * size
        extent = random.uniform(0.03, 0.2, 2) * camera.height
        box = cv2.boxPoints((middle.tolist(), extent.tolist(), float(random.uniform(0, 180))))
        cv2.fillPoly(room, [np.round(box).astype(np.int32)], float(random.uniform(30, 190)))
    return np.asarray(cv2.GaussianBlur(room, (0, 0), camera.height / 400), dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _print(image, rays, inverse, cells, black, white):
    """Draw a sheet over a window of the image.

    Args:
        image: (h, w) grey, changed in place.
        rays: (h + 1, w + 1, 2) x / z and y / z at the pixels' corners.
        inverse: (3, 3) of the matrix of the sheet's upper edge, left edge and upper left corner,
            so that it takes a ray to the place on the sheet, times what depth is divided by.
        cells: (rows, columns), True is white.
        black: grey.
        white: grey.
    """
    height, width = image.shape
    rows, columns = cells.shape
    x = np.empty((height + 1, width + 1))
    y = np.empty((height + 1, width + 1))
    for i in range(height + 1):
        for j in range(width + 1):
            a, b = rays[i, j]
            scale = inverse[2, 0] * a + inverse[2, 1] * b + inverse[2, 2]
            if not scale > 0:
                x[i, j] = np.nan
                y[i, j] = np.nan
                continue
            x[i, j] = columns * (inverse[0, 0] * a + inverse[0, 1] * b + inverse[0, 2]) / scale
            y[i, j] = rows * (inverse[1, 0] * a + inverse[1, 1] * b + inverse[1, 2]) / scale
    for i in range(height):
        for j in range(width):
            xa, xb, xc, xd = x[i, j], x[i, j + 1], x[i + 1, j], x[i + 1, j + 1]
            ya, yb, yc, yd = y[i, j], y[i, j + 1], y[i + 1, j], y[i + 1, j + 1]
            left, right = min(min(xa, xb), min(xc, xd)), max(max(xa, xb), max(xc, xd))
            top, bottom = min(min(ya, yb), min(yc, yd)), max(max(ya, yb), max(yc, yd))
            if not (right > 0 and left < columns and bottom > 0 and top < rows):
                continue
            column, row = int(np.floor(left)), int(np.floor(top))
            if right <= column + 1 and bottom <= row + 1 and column >= 0 and row >= 0:
                image[i, j] = white if cells[row, column] else black
                continue
            x4, y4 = (xa, xb, xc, xd), (ya, yb, yc, yd)
            total, inside = _sum_samples(cells, x4, y4, black, white)
            weight = 1.0 / (_SAMPLES * _SAMPLES)
            image[i, j] = weight * total + (1 - weight * inside) * image[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_samples(cells, x, y, black, white):
    """Sum the grey of samples in a pixel with corners at x (4), y (4) cells, and count them."""
    (xa, xb, xc, xd), (ya, yb, yc, yd) = x, y
    rows, columns = cells.shape
    total, inside = 0.0, 0
    for k in range(_SAMPLES):
        for m in range(_SAMPLES):
            # No two samples lie in a row or a column, so that no slant is favoured.
            s = (k + (m + 0.5) / _SAMPLES) / _SAMPLES
            t = (m + (k + 0.5) / _SAMPLES) / _SAMPLES
            across = (1 - t) * ((1 - s) * xa + s * xb) + t * ((1 - s) * xc + s * xd)
            along = (1 - t) * ((1 - s) * ya + s * yb) + t * ((1 - s) * yc + s * yd)
            if 0 <= across < columns and 0 <= along < rows:
                inside += 1
                total += white if cells[int(along), int(across)] else black
    return total, inside


@njit(cache=True, nogil=True, error_model="numpy")
def _expose(light, noise, read_variance, shot_variance, image):
    """Return grey levels (h, w) of the light, with noise that grows with it."""
    for i in range(light.shape[0]):
        for j in range(light.shape[1]):
            value = light[i, j]
            deviation = np.sqrt(read_variance + shot_variance * max(value, 0.0))
            value += deviation * noise[i, j]
            image[i, j] = int(min(max(value, 0.0), 255.0) + 0.5)
