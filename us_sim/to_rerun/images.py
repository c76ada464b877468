"""Images: in two dimensions as they are, and the ultrasound image in the plane that it shows."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import rerun
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.nodes.conversions import affine_from, colour_pixels_from, field_from, pixels_from
from us_sim.to_rerun.rerun_file import RerunFile

IMAGE = "ultrasound/image"
PLANE = "ultrasound/plane"
"""Entity of the image in three dimensions."""
_WHERE = "ultrasound/image_to_probe"
_FINEST = 256
"""Pixels across the texture in three dimensions, where the image itself is beside it."""


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
