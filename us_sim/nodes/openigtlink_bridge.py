"""A bridge that sends image and probe to 3D Slicer, or to other clients of OpenIGTLink."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from us_sim.errors import ProbeError
from us_sim.nodes.guarded_node import keep_newest
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import node_main
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import OpenIGTLinkBridgeSettings
from us_sim.recording.decoding import affine_from, nanoseconds_of, pixels_from, pose_from
from us_sim.tracking.openigtlink import OpenIGTLinkServer, pack_image, pack_transform

REMEMBERED = 256  # poses kept for the images that carry their stamps
CLIENTS_S = 0.5  # between two counts of the connected clients


class OpenIGTLinkBridge(SceneNode):
    """``probe/pose`` and ``ultrasound/image`` in; an OpenIGTLink server out.

    It sends the image ``Image_Reference``, placed in the reference frame, and the transforms
    ``ImageToReference`` and ``ProbeToReference``. Its own parameters are those of
    `OpenIGTLinkBridgeSettings`. If the reference is the volume's own frame, the images fit the
    volume's file in Slicer.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("openigtlink_bridge", **kwargs)
        settings = declare_settings(self, OpenIGTLinkBridgeSettings())
        volume = self.scene.volume.pose.pose
        # Volumes are read in LPS; RAS, as 3D Slicer has it, has x and y turned round.
        self._from_patient = np.diag([-1.0, -1.0, 1.0, 1.0])
        if settings.reference == "volume":
            self._from_patient = self._from_patient @ volume.inverse().matrix
        self._image_to_probe: NDArray[np.float64] | None = None
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._image: Image | None = None
        self._connected = -1
        self._server = OpenIGTLinkServer(settings.host or "", settings.port)
        self.port = self._server.port  # at which it listens
        self.subscribe(
            Float64MultiArray, "ultrasound/image_to_probe", self._on_image_place, LATCHED
        )
        self.subscribe(PoseStamped, "probe/pose", self._on_pose)
        self.subscribe(Image, "ultrasound/image", self._on_image, newest=True)
        self.create_timer(CLIENTS_S, self._count_clients)
        self.get_logger().info(f"serving OpenIGTLink on port {self.port}")

    def destroy_node(self) -> None:
        """Disconnect all clients."""
        self._server.close()
        super().destroy_node()

    def _count_clients(self) -> None:
        clients = self._server.client_count
        if clients != self._connected:
            self._connected = clients
            self.health.state = f"{clients} connected" if clients else "waiting for a client"
            self.get_logger().info(self.health.state)

    def _on_image_place(self, message: Float64MultiArray) -> None:
        matrix = affine_from(message)
        # As thick as a pixel is wide: the simulation's own matrix has a slice a metre thick.
        normal, step = np.linalg.norm(matrix[:3, 2]), np.linalg.norm(matrix[:3, 0])
        if not normal > 0.0 or not step > 0.0:
            raise ProbeError("the matrix gives pixels no size")
        matrix[:3, 2] *= step / normal
        self._image_to_probe = matrix

    def _on_pose(self, message: PoseStamped) -> None:
        pose = pose_from(message, "patient")
        stamp = nanoseconds_of(message.header.stamp)
        matrix = self._from_patient @ pose.matrix
        keep_newest(self._poses, stamp, matrix, REMEMBERED)
        self._send_transform("ProbeToReference", stamp, matrix)
        if self._image is not None:
            self._on_image(self._image)

    def _on_image(self, message: Image) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        self._image = None
        if self._image_to_probe is None or not self._server.client_count:
            return
        if stamp not in self._poses:
            self._image = message  # its pose may come after it, over another connection
            return
        pixels = pixels_from(message)
        matrix = self._poses[stamp] @ self._image_to_probe
        name = "Image_Reference"
        self._server.send_message(name, pack_image(name, stamp, pixels, matrix, "ras"))
        self.health.count_published(name, message.header.stamp)
        self._send_transform("ImageToReference", stamp, matrix, per_pixel=True)

    def _send_transform(
        self, name: str, stamp: int, matrix: NDArray[np.float64], *, per_pixel: bool = False
    ) -> None:
        if self._server.client_count:
            self._server.send_message(
                name, pack_transform(name, stamp, matrix, per_pixel=per_pixel)
            )
            self.health.count_published(name)


main = node_main(OpenIGTLinkBridge, __name__)
