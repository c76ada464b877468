"""Load for the recorder: messages of a megabyte each at so many MB/s, for so long.

    python tests/nodes/recorder_load.py 200 30 FOLDER

It says how many were published and recorded, what the recorder says that it lost, and the time of
processors that it took. It fails when messages are missing that the recorder does not tell of.
"""

import signal
import subprocess
import sys
import time
from pathlib import Path

from us_sim.recording.reader import read_bag

SIZE = 1_000_000  # bytes


def processor_time(pid: int) -> float:
    """s of user and system time that a process has taken."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def main(rate: float, duration: float, folder: Path) -> int:
    """Publish ``rate`` MB/s for ``duration`` s to a recorder in ``folder``."""
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from std_msgs.msg import String

    file = folder / "session.mcap"
    command = [sys.executable, "-m", "us_sim.nodes.session_recorder", "--ros-args"]
    recorder = subprocess.Popen([*command, "-p", f"file:={file}", "-p", "topics:=[/load]"])
    rclpy.init()
    node = Node("load")
    # What a publisher overwrites before it was sent reaches nobody, and nobody can tell.
    publisher = node.create_publisher(String, "load", QoSProfile(depth=1000))
    while not publisher.get_subscription_count():
        rclpy.spin_once(node, timeout_sec=0.1)
    data = b"\0\1\0\0" + (SIZE - 8).to_bytes(4, "little") + b"x" * (SIZE - 9) + b"\0"
    count, took, began = 0, processor_time(recorder.pid), time.monotonic()
    while (now := time.monotonic() - began) < duration:
        if count * SIZE < now * rate * 1e6:
            publisher.publish(data)
            count += 1
        else:
            time.sleep(0.001)
    seconds = time.monotonic() - began
    time.sleep(1.0)  # what is on its way
    took = processor_time(recorder.pid) - took
    recorder.send_signal(signal.SIGINT)
    recorder.wait(60)
    rclpy.shutdown()
    bag = read_bag(file)
    recorded, lost = bag.message_count, sum(bag.count_losses().values())
    print(
        f"{count} published ({count * SIZE / seconds / 1e6:.0f} MB/s), {recorded} recorded, "
        f"{lost} lost by the recorder's account, {count - recorded - lost} of which it knows "
        f"nothing; the recorder took {took / seconds:.0%} of a core"
    )
    return int(recorded + lost != count)


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3])))
