"""Makes a volume of the images that come, at the probe's poses, and saves it when it is told to."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from us_sim.errors import UsSimError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import EVERY, LATCHED
from us_sim.recording.decoding import affine_from, nanoseconds_of, pixels_from, pose_from
from us_sim.volume.files.writing import write_volume
from us_sim.volume.reconstruction.reconstruction import LiveReconstruction
from us_sim.volume.reconstruction.settings import LiveBox, LiveVolume

SECONDS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""Images that wait while the volume is saved."""
REMEMBERED = 256  # poses, and images, kept for what has the same stamp


class VolumeReconstructor(GuardedNode):
    """``ultrasound/image`` and ``probe/pose`` of equal stamps in, a volume on a service.

    ``ultrasound/image_to_probe`` says where pixels lie on the probe; where nobody publishes it,
    the parameters ``pixel_size`` and ``first_pixel`` do. Services: ``~/save`` writes the volume to
    ``file``, or to the next name that is free, ``~/clear`` begins anew.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("volume_reconstructor", **kwargs)
        self._settings = declared(self, LiveVolume())
        self._live = LiveReconstruction(declared(self, LiveBox()))
        self._place = self._settings.image_to_probe
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._images: dict[int, NDArray[np.uint8]] = {}
        self.health = Health(self, self._settings.file)
        for kind, topic, take, qos in (
            (PoseStamped, "probe/pose", self._take_pose, EVERY),
            (Image, "ultrasound/image", self._take_image, SECONDS),
            (Float64MultiArray, "ultrasound/image_to_probe", self._take_place, LATCHED),
        ):
            self.create_subscription(kind, topic, take, qos)
        self.create_service(Trigger, "~/save", self._save)
        self.create_service(Trigger, "~/clear", self._clear)
        self.health.state = "ready"

    @property
    def frames(self) -> int:
        """How many images were inserted."""
        return self._live.frames

    def _take_place(self, message: Float64MultiArray) -> None:
        self._place = affine_from(message)

    def _take_pose(self, message: PoseStamped) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        pose = pose_from(message, "patient").matrix
        image = self._images.pop(stamp, None)
        if image is not None:
            self._insert(image, pose)
        else:
            self._keep(self._poses, stamp, pose)

    def _take_image(self, message: Image) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        self.health.received += 1
        pose = self._poses.pop(stamp, None)
        if pose is not None:
            self._insert(pixels_from(message), pose)
        else:
            self.health.dropped += self._keep(self._images, stamp, pixels_from(message))

    def _keep(self, kept: dict[int, Any], stamp: int, value: Any) -> int:
        """Keep a message until its counterpart comes; return how many were dropped."""
        kept[stamp] = value
        if len(kept) <= REMEMBERED:
            return 0
        del kept[next(iter(kept))]
        return 1

    def _insert(self, image: NDArray[np.uint8], pose: NDArray[np.float64]) -> None:
        self._live.insert(image, pose @ self._place)
        self.health.state = "inserting"
        self.health.values = {"frames": str(self._live.frames)}

    def _save(self, _: Any, response: Any) -> Any:
        try:
            volume, file = self._live.volume(), _free(Path(self._settings.file))
            write_volume(file, volume)
        except UsSimError as error:
            response.success, response.message = False, str(error)
            return response
        size = " × ".join(map(str, volume.shape))
        response.success = True
        response.message = f"{file}: {size} voxels from {self._live.frames} images"
        self.get_logger().info(response.message)
        return response

    def _clear(self, _: Any, response: Any) -> Any:
        response.success, response.message = True, f"{self._live.frames} images are forgotten"
        self._live.clear()
        return response


def _free(file: Path) -> Path:
    if not file.exists():
        return file
    stem, dot, ending = file.name.partition(".")
    numbered = (file.with_name(f"{stem}_{n}{dot}{ending}") for n in range(1, 1 << 20))
    return next(name for name in numbered if not name.exists())


main = partial(run_node, VolumeReconstructor)


if __name__ == "__main__":
    sys.exit(main())
