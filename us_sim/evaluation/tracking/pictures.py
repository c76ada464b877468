"""A sheet of what is tracked: each body in each condition."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from us_sim.evaluation.tracking.cases import CONDITIONS, MARKERS, SMALL, Case
from us_sim.tracking.camera.rendered_views import WEBCAMS, RenderedView

_CUT = 240  # pixels, of the image around the body
_TITLE = 22  # pixels


def draw_views(file: Path) -> None:
    """Write a picture with a row for each condition and a column for each body."""
    rooms = {name: RenderedView(WEBCAMS[SMALL], MARKERS[name].body) for name in MARKERS}
    rows = []
    for condition, (settings, _) in CONDITIONS.items():
        cells = []
        for name in MARKERS:
            case = Case(name, SMALL, 0.4, 30.0, condition)
            pose, body = case.sequence(0)[0], MARKERS[name].body
            image = rooms[name].render(pose, settings, 3, case.motion(0))
            middle = WEBCAMS[SMALL].project(pose.apply(body.centres.mean(axis=0)[None]))[0]
            high, wide = image.shape
            top = int(np.clip(middle[1] - _CUT / 2, 0, high - _CUT))
            left = int(np.clip(middle[0] - _CUT / 2, 0, wide - _CUT))
            cells.append(_titled(image[top : top + _CUT, left : left + _CUT], name, condition))
        rows.append(np.hstack(cells))
    cv2.imwrite(str(file), np.vstack(rows))


def _titled(image: np.ndarray, name: str, condition: str) -> np.ndarray:
    strip = np.full((_TITLE, image.shape[1]), 255, dtype=np.uint8)
    text = f"{name}, {condition}"
    cv2.putText(strip, text, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 0, 1, cv2.LINE_AA)
    return np.vstack([strip, image])
