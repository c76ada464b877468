"""Writes the images of a session as numbered files, and what is known of them if asked for."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
from sensor_msgs.msg import Image

from us_sim.errors import UsSimError
from us_sim.nodes.conversions import nanoseconds_of, pixels_from
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import EVERY, overridable
from us_sim.nodes.settings import ImageWriterSettings
from us_sim.nodes.truth_files import TruthFiles


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
        self.create_subscription(
            Image, "ultrasound/image", self._write, EVERY, qos_overriding_options=overridable()
        )
        self.truth = TruthFiles(
            self, {topic: _made(name) for topic, name in wanted.items() if name}
        )

    def _write(self, message: Image) -> None:
        file = self._folder / f"{self.count:06d}.png"
        if not cv2.imwrite(str(file), pixels_from(message)):
            raise OSError(f"{file} cannot be written; choose another folder")
        self.truth.image_came(self.count, nanoseconds_of(message.header.stamp))
        self.count += 1


def _made(name: str) -> Path:
    """The folder, which is there now."""
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsSimError(f"the folder {folder} cannot be made: {why}") from None
    return folder


def main(args: list[str] | None = None) -> int:
    """Write until interrupted."""
    return run_node(ImageWriter, args)


if __name__ == "__main__":
    sys.exit(main())
