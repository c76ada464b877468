"""Writes the images of a session as numbered PNG files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
from sensor_msgs.msg import Image

from us_sim.errors import UsSimError
from us_sim.nodes.conversions import pixels_from
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import EVERY, overridable
from us_sim.nodes.settings import ImageWriterSettings

__all__ = ["ImageWriter", "main"]


class ImageWriter(GuardedNode):
    """``ultrasound/image`` to ``folder/000000.png``, ``000001.png``, …"""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("image_writer", **kwargs)
        self._folder = Path(declared(self, ImageWriterSettings()).folder)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            raise UsSimError(f"the folder {self._folder} cannot be made: {why}") from None
        self.count = 0
        self.create_subscription(
            Image, "ultrasound/image", self._write, EVERY, qos_overriding_options=overridable()
        )

    def _write(self, message: Image) -> None:
        file = self._folder / f"{self.count:06d}.png"
        if not cv2.imwrite(str(file), pixels_from(message)):
            raise OSError(f"{file} cannot be written; choose another folder")
        self.count += 1


def main(args: list[str] | None = None) -> int:
    """Write until interrupted."""
    return run_node(ImageWriter, args)


if __name__ == "__main__":
    sys.exit(main())
