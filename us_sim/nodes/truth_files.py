"""What is known of each image, in files numbered as the images are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import field_from, nanoseconds_of, pixels_from
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.qos import EVERY, overridable

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
            node.create_subscription(
                Image, topic, self._taking(topic), EVERY, qos_overriding_options=overridable()
            )

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

    def _taking(self, topic: str) -> Callable[[Image], None]:
        def take(message: Image) -> None:
            stamp = nanoseconds_of(message.header.stamp)
            if stamp in self._numbers:
                self._write(topic, message, self._numbers[stamp])
            else:
                self._early[topic, stamp] = message
                _forget(self._early)

        return take

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
