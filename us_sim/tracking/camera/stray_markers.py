"""A sentence on the other markers in an image that lacks the ones looked for."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.settings.spelling import counted
from us_sim.tracking.camera.markers import dictionary, family
from us_sim.tracking.camera.rigid_body import RigidBody


class StrayMarkers:
    """Looks for markers that are not the body's, where none of its own is found.

    It tries one dictionary an image, since all would take long.
    """

    _FAMILIES = (
        "4X4_1000",
        "5X5_1000",
        "6X6_1000",
        "7X7_1000",
        "ARUCO_ORIGINAL",
        "ARUCO_MIP_36h12",
        "APRILTAG_36h11",
        "APRILTAG_25h9",
    )

    def __init__(self, body: RigidBody) -> None:
        self._body = body
        own = family(body.dictionary)
        # The own family first: a marker of another number is the likeliest mistake.
        self._families = (own, *(name for name in self._FAMILIES if name != own))
        self._turn = 0
        self._found = ""

    def look(self, image: NDArray[np.uint8], start: str) -> str:
        """The sentence that begins with ``start`` and goes on with what is there instead."""
        name = self._families[self._turn % len(self._families)]
        if self._turn % len(self._families) == 0:
            self._found = ""
        self._turn += 1
        numbers = _numbers_in(image, name)
        if numbers:
            listed = ", ".join(str(number) for number in numbers[:5])
            own = name == self._families[0]
            markers = counted(len(numbers), "marker")
            self._found = (
                f", only {markers} that the body lacks ({listed}): check the body's numbers"
                if own
                else f", but {markers} of {name} ({listed}): check camera.dictionary"
            )
        return start.replace("no marker", "no marker of the body") + self._found


def _numbers_in(image: NDArray[np.uint8], name: str) -> list[int]:
    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate = 0.0
    ids = cv2.aruco.ArucoDetector(dictionary(name), parameters).detectMarkers(image)[1]
    return [] if ids is None else np.unique(np.asarray(ids, dtype=np.int64)).tolist()
