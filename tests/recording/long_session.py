"""Two hours of a session: how long it takes to open, and to go anywhere in it.

`python tests/recording/long_session.py FOLDER [HOURS]` writes FOLDER/long.mcap with as many chunks
and channels as a session has, of small messages, and prints times on the wall
and of the processor. A session fills a chunk (768 kB) with two frames.
"""

import os
import random
import sys
import time
from pathlib import Path

from rosbags.interfaces import QosDurability

from us_sim.recording.reader import read_bag
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter

EPOCH = 1_700_000_000_000_000_000
FRAME = 16_666_667  # ns
TOPICS = 10
TEXT = bytes.fromhex("00010000 03000000 686900")


def write(file, frames):
    with BagWriter(file, chunk_size=1 << 30, sidecar=False) as bag:
        for k in range(TOPICS):
            bag.add_topic(f"/topic_{k}", "std_msgs/msg/String", [DEFAULT_QOS])
        latched = DEFAULT_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL)
        bag.add_topic("/mesh", "std_msgs/msg/String", [latched])
        bag.write_message("/mesh", TEXT, EPOCH)
        for frame in range(frames):
            at = EPOCH + frame * FRAME
            for k in range(TOPICS):
                if (frame + k) % 2:  # one of each topic in a chunk is enough for its index
                    bag.write_message(f"/topic_{k}", TEXT, at + k, at, frame)
            if frame % 2:
                bag.flush()
    return file


def measure(file):
    began = time.perf_counter(), time.process_time()
    bag = read_bag(file)
    first = next(bag.read_messages())
    opened = time.perf_counter() - began[0], time.process_time() - began[1]
    assert first.topic == "/mesh"
    length = bag.end - bag.start
    seeks, rng = [], random.Random(1)
    for _ in range(200):
        at = bag.start + rng.randrange(length)
        began = time.process_time()
        (mesh,) = bag.read_latest(["/mesh"], at, 10)
        message = next(bag.read_messages(since=at))
        seeks.append(time.process_time() - began)
        assert mesh == first
        assert 0 <= message.log_time - at < 2 * FRAME
    return opened, sorted(seeks)


def main(folder, hours=2.0):
    file = Path(folder) / "long.mcap"
    if not file.exists():
        write(file, round(hours * 3600 * 60))
    opened, seeks = measure(file)
    median = 1e3 * seeks[len(seeks) // 2]
    print(
        f"{os.path.getsize(file) / 1e6:.0f} MB: opened in {opened[0]:.3f} s, {opened[1]:.3f} s of "
        f"the processor's; of {len(seeks)} seeks the median took {median:.1f} ms "
        f"of it, the slowest {1e3 * seeks[-1]:.1f}"
    )


if __name__ == "__main__":
    main(sys.argv[1], *map(float, sys.argv[2:]))
