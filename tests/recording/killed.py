"""A recorder killed again and again: what is on disk after each ``kill -9``.

    python tests/recording/killed.py 200

It says how much of the last second was lost, and fails when anything older than that is missing,
or a payload is not what was sent.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from us_sim.recording import writer
from us_sim.recording.reader import read_bag

TOPICS = {"/pose": 200, "/nodes": 40_000, "/image": 262_144}
"""Sizes of messages, which come 60 times a second each."""

RECORDER = f"""
import sys, time
from us_sim.recording.write_behind import WriteBehind
from us_sim.recording.writer import BagWriter
sys.path.insert(0, {str(Path(__file__).parent)!r})
from killed import TOPICS, payload
bag = WriteBehind(BagWriter(sys.argv[1], compression=sys.argv[2]), 10**8)
for topic in TOPICS:
    bag.add_topic(topic, "std_msgs/msg/String")
k = 0
while True:
    for topic in TOPICS:
        data, now = payload(topic, k), time.time_ns()
        assert bag.put(topic, data, now)
        print(topic, k, now, flush=True)
    k += 1
    time.sleep(1 / 60)
"""


def payload(topic: str, k: int) -> bytes:
    """A std_msgs/String of the topic's size; no two are alike."""
    text = (f"{topic} {k} " * (TOPICS[topic] // 8))[: TOPICS[topic]].encode()
    return b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text + b"\0"


def kill_once(folder: Path, after: float, compression: str) -> float:
    """Kill a recorder that long after its first message; s of messages that were lost."""
    file = folder / "session.mcap"
    project = str(Path(writer.__file__).parents[2])
    with subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(file), compression],
        env=os.environ | {"PYTHONPATH": project},
        stdout=subprocess.PIPE,
        text=True,
    ) as recorder:
        first = recorder.stdout.readline()
        time.sleep(after)
        recorder.send_signal(signal.SIGKILL)
        killed = time.time_ns()
        lines = [first, *recorder.stdout]
    sent = [line.split() for line in lines if line.endswith("\n")]
    sent = {(topic, int(time)): int(k) for topic, k, time in sent}
    there = {(m.topic, m.log_time): m.data for m in read_bag(file).read_messages()}
    for (topic, time_ns), data in there.items():
        # The last message may have been put, and its line not printed any more.
        k = sent.get((topic, time_ns), max(sent.values(), default=0) + 1)
        assert data in (payload(topic, k), payload(topic, k - 1)), "a payload was changed"
    missing = [time_ns for topic, time_ns in sent if (topic, time_ns) not in there]
    lost = (killed - min(missing, default=killed)) / 1e9
    assert lost < 1.0, f"a message {lost:.2f} s old is missing"
    return lost


def main(times: int) -> None:
    """Kill a recorder so many times at random moments of its first three seconds."""
    random.seed(1)
    lost = []
    for _ in range(times):
        with tempfile.TemporaryDirectory() as folder:
            after = random.uniform(0, 3)
            lost.append(kill_once(Path(folder), after, random.choice(["none", "zstd"])))
    print(
        f"{times} times killed: {max(lost):.3f} s lost at most, {sum(lost) / times:.3f} s usually"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]))
