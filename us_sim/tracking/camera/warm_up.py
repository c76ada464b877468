"""Tracking of a drawn image at the start, so that the first real one finds all compiled.

>>> from us_sim.tracking.camera.warm_up import practice
>>> from us_sim.tracking.camera.rigid_body import RigidBody
>>> practice(RigidBody.single("4X4_50", 7, 0.04))
True
"""

from __future__ import annotations

import cv2
import numpy as np

from us_sim.tracking.camera.markers import dictionary
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rigid_body import RigidBody
from us_sim.tracking.camera.source import CameraSource


def practice(body: RigidBody) -> bool:
    """Track a drawn marker, or board, twice: from nowhere and from near. Whether it was found."""
    camera = CameraModel(640, 480, np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]]))
    image = np.full((480, 640), 255, dtype=np.uint8)
    if body.chessboard is not None:
        image[40:440, 70:570] = body.chessboard.board.generateImage((500, 400))
    else:
        number = int(body.ids[0])
        body = RigidBody.single(body.dictionary, number, 0.04)
        marker = cv2.aruco.generateImageMarker(dictionary(body.dictionary), number, 120)
        image[180:300, 260:380] = marker
    source = CameraSource(camera, body)
    return [source.measure(image, stamp) is not None for stamp in (0, 33_000_000)] == [True] * 2
