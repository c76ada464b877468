"""Small sessions of known content: a press at 60 Hz, one wrench, cloud and image for each pose."""

import numpy as np

from us_sim.recording.schemas import load_jazzy_definitions, serialize_stamped
from us_sim.recording.writer import BagWriter

EPOCH = 1_700_000_000_000_000_000
PERIOD = 16_666_667
STRING = "std_msgs/msg/String"
HI = bytes.fromhex("00010000 03000000 686900")
"""The CDR of a String "hi"."""
TYPES = {
    "/probe/pose": "geometry_msgs/msg/PoseStamped",
    "/tissue/nodes": "sensor_msgs/msg/PointCloud2",
    "/probe/wrench": "geometry_msgs/msg/WrenchStamped",
    "/ultrasound/image": "sensor_msgs/msg/Image",
}
T = load_jazzy_definitions().types


def text(content):
    """A std_msgs/String of ASCII text as CDR."""
    return b"\0\1\0\0" + (len(content) + 1).to_bytes(4, "little") + content.encode() + b"\0"


def pose(stamp, z=0.0, x=0.0, w=1.0):
    made = T["geometry_msgs/msg/Pose"](
        position=T["geometry_msgs/msg/Point"](x, 0.0, z),
        orientation=T["geometry_msgs/msg/Quaternion"](0.0, 0.0, (1 - w * w) ** 0.5, w),
    )
    return serialize_stamped(TYPES["/probe/pose"], stamp, "patient", pose=made)


def cloud(stamp, nodes):
    field, nodes = T["sensor_msgs/msg/PointField"], np.asarray(nodes, "<f4")
    return serialize_stamped(
        TYPES["/tissue/nodes"],
        stamp,
        "patient",
        height=1,
        width=len(nodes),
        fields=[field(name, 4 * i, 7, 1) for i, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(nodes),
        data=np.frombuffer(nodes.tobytes(), np.uint8),
        is_dense=True,
    )


def wrench(stamp, force):
    vector = T["geometry_msgs/msg/Vector3"]
    made = T["geometry_msgs/msg/Wrench"](force=vector(0.0, 0.0, force), torque=vector(0, 0, 0))
    return serialize_stamped(TYPES["/probe/wrench"], stamp, "probe", wrench=made)


def image(stamp, pixels):
    pixels = np.asarray(pixels, np.uint8)
    return serialize_stamped(
        TYPES["/ultrasound/image"],
        stamp,
        "probe",
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding="mono8",
        is_bigendian=0,
        step=pixels.shape[1],
        data=pixels.ravel(),
    )


def press(count=120):
    """Messages of a press: lists of topic, bytes, log time, publish time, number."""
    ramp = np.add.outer(np.arange(8), np.arange(6)).astype(np.uint8)
    nodes = np.arange(12.0).reshape(4, 3) * 1e-2
    made = []
    for k in range(count):
        stamp = EPOCH + k * PERIOD
        depth = 0.008 * np.sin(np.pi * k / count)
        contents = (
            pose(stamp, depth),
            cloud(stamp, nodes + np.array([0, 0, depth])),
            wrench(stamp, -1e3 * depth),
            image(stamp, ramp + k % 200),
        )
        for late, (topic, data) in enumerate(zip(TYPES, contents, strict=True), 1):
            sent = stamp + late * 1_000_000
            made.append([topic, bytes(data), sent + 300_000, sent, k + 1])
    return made


def write(file, messages, attach=()):
    """The messages as a bag, with attached files by name."""
    with BagWriter(file, chunk_size=4000, sidecar=False) as bag:
        for topic, kind in TYPES.items():
            bag.add_topic(topic, kind)
        for name, text in dict(attach).items():
            bag.attach_file(name, "text/plain", text, EPOCH)
        for topic, data, logged, sent, number in messages:
            bag.write_message(topic, data, logged, sent, number)
    return file
