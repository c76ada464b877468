"""Writes the images of a session as numbered files, and labels and displacements if asked for."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import Image

from us_sim.errors import UsSimError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import EVERY
from us_sim.nodes.settings import ImageWriterSettings
from us_sim.recording.decoding import field_from, nanoseconds_of, pixels_from

REMEMBERED = 1000
"""Images whose numbers are kept for what is known of them, and messages that wait for theirs."""


class TruthFiles:
    """Labels as ``000000.png``, displacement as ``000000.npy``: each by the stamp of its image.

    Args:
        node: that subscribes.
        folders: where the messages of each topic go; they are there.
    """

    def __init__(self, node: GuardedNode, folders: dict[str, Path]) -> None:
        self.count = 0  # of files
        self._numbers: dict[int, int] = {}  # of images, by their stamps in ns
        self._early: dict[tuple[str, int], Image] = {}
        self._folders = folders
        for topic in folders:
            node.subscribe(Image, topic, partial(self._on_truth, topic), EVERY)

    def image_came(self, number: int, stamp: int) -> None:
        """The image with that stamp (ns) has that number."""
        if not self._folders:
            return
        self._numbers[stamp] = number
        _forget(self._numbers)
        for topic in self._folders:
            message = self._early.pop((topic, stamp), None)
            if message is not None:
                self._write(topic, message, number)

    def _on_truth(self, topic: str, message: Image) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        if stamp in self._numbers:
            self._write(topic, message, self._numbers[stamp])
        else:
            self._early[topic, stamp] = message
            _forget(self._early)

    def _write(self, topic: str, message: Image, number: int) -> None:
        stem = self._folders[topic] / f"{number:06d}"
        if message.encoding in ("mono8", "8UC1"):
            file = stem.with_suffix(".png")
            if not cv2.imwrite(str(file), pixels_from(message)):
                raise OSError(f"{file} cannot be written; choose another folder")
        else:
            np.save(stem.with_suffix(".npy"), field_from(message))
        self.count += 1


def _forget(kept: dict[Any, Any]) -> None:
    while len(kept) > REMEMBERED:
        del kept[next(iter(kept))]


class ImageWriter(GuardedNode):
    """``ultrasound/image`` to ``folder/000000.png``, ``000001.png``, …

    Where the parameters give folders for them, ``ultrasound/labels`` and
    ``ultrasound/displacement`` of each image go to files of its number.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("image_writer", **kwargs)
        settings = declared(self, ImageWriterSettings())
        self._folder = _made(settings.folder)
        wanted = {
            "ultrasound/labels": settings.labels,
            "ultrasound/displacement": settings.displacement,
        }
        self.count = 0
        self.subscribe(Image, "ultrasound/image", self._on_image, EVERY)
        self.truth = TruthFiles(
            self, {topic: _made(name) for topic, name in wanted.items() if name}
        )

    def _on_image(self, message: Image) -> None:
        file = self._folder / f"{self.count:06d}.png"
        if not cv2.imwrite(str(file), pixels_from(message)):
            raise OSError(f"{file} cannot be written; choose another folder")
        self.truth.image_came(self.count, nanoseconds_of(message.header.stamp))
        self.count += 1


def _made(name: str) -> Path:
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsSimError(f"the folder {folder} cannot be made: {why}") from None
    return folder


main = partial(run_node, ImageWriter)


if __name__ == "__main__":
    sys.exit(main())
