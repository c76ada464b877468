"""Writing a session's images, labels and displacements as numbered files."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import Image

from us_sim.errors import UsSimError
from us_sim.nodes.guarded_node import GuardedNode, keep_newest
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import node_main
from us_sim.nodes.qos import EVERY
from us_sim.nodes.settings import ImageWriterSettings
from us_sim.recording.decoding import field_from, nanoseconds_of, pixels_from

REMEMBERED = 1000  # images whose numbers are kept for their labels and displacements


class ImageWriter(GuardedNode):
    """Writes ``ultrasound/image`` to ``folder/000000.png``, ``000001.png`` and so on.

    If the parameters give folders for them, it also writes ``ultrasound/labels`` (``.png``) and
    ``ultrasound/displacement`` (``.npy``), with the number of the image of the same stamp.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("image_writer", **kwargs)
        settings = declare_settings(self, ImageWriterSettings())
        wanted = {
            "ultrasound/image": settings.folder,
            "ultrasound/labels": settings.labels,
            "ultrasound/displacement": settings.displacement,
        }
        self.counts: Counter[str] = Counter()  # files of each topic
        self._numbers: dict[int, int] = {}  # by stamps, ns
        self._next = 0
        for topic, name in wanted.items():
            if name:
                callback = partial(self._write, topic, _create_folder(name))
                self.subscribe(Image, topic, callback, EVERY)

    def _write(self, topic: str, folder: Path, message: Image) -> None:
        stem = folder / f"{self._number(nanoseconds_of(message.header.stamp)):06d}"
        if message.encoding in ("mono8", "8UC1"):
            file = stem.with_suffix(".png")
            if not cv2.imwrite(str(file), pixels_from(message)):
                raise OSError(f"{file} cannot be written; choose another folder")
        else:
            np.save(stem.with_suffix(".npy"), field_from(message))
        self.counts[topic] += 1

    def _number(self, stamp: int) -> int:
        """Return the number of a stamp: the next number if nothing with it has come yet."""
        if stamp not in self._numbers:
            keep_newest(self._numbers, stamp, self._next, REMEMBERED)
            self._next += 1
        return self._numbers[stamp]


def _create_folder(name: str) -> Path:
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsSimError(f"the folder {folder} cannot be made: {why}") from None
    return folder


main = node_main(ImageWriter, __name__)
