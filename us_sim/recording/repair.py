"""Repairing a recording: all that can be read of it, in a new bag with an index.

>>> import tempfile
>>> from us_sim.recording.reader import read_bag
>>> from us_sim.recording.repair import repair
>>> from us_sim.recording.writer import BagWriter
>>> folder = tempfile.mkdtemp()
>>> with BagWriter(folder + "/session.mcap") as writer:
...     writer.add_topic("/note", "std_msgs/msg/String")
...     writer.write("/note", bytes.fromhex("00010000 03000000 686900"), 1_700_000_000_000_000_000)
>>> content = open(folder + "/session.mcap", "rb").read()
>>> open(folder + "/cut.mcap", "wb").write(content[:-100]) == len(content) - 100
True
>>> repair(folder + "/cut.mcap", folder + "/whole").message_count
1
>>> read_bag(folder + "/whole").complete
True
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import BagTopic, Fault
from us_sim.recording.writer import BagWriter


@dataclass(frozen=True)
class Repaired:
    """What came of a repair."""

    path: Path  # the new file
    message_count: int
    faults: tuple[Fault, ...]  # what was wrong with the bag; none if it was whole


def repair(path: str | Path, out: str | Path) -> Repaired:
    """Write what can be read of a bag as a new one; the bag itself is not touched.

    Args:
        path: the bag, as `read_bag` takes it.
        out: where the new bag goes, as `BagWriter` takes it.

    Raises:
        BagError: there is no bag, nothing of it can be read, ``out`` is there already, or it
            cannot be written.
    """
    bag = read_bag(path)
    damage = [*bag.found_at_once]
    with BagWriter(out) as writer:
        for attached in bag.attachments(damage).values():
            writer.attach(attached.name, attached.media_type, attached.data, attached.time)
        for note in bag.notes(damage):
            if note.name != "rosbag2":  # which the writer makes anew
                writer.note(*note)
        for topic in bag.topics:
            if topic.encoding != "cdr":
                damage.append(_left_out(topic, f"{topic.encoding} is not CDR"))
                continue
            try:
                writer.add_topic(
                    topic.name,
                    topic.type_name,
                    topic.qos,
                    topic.type_hash or None,
                    schema=topic.schema,
                    defined=False,
                )
            except BagError as error:
                damage.append(_left_out(topic, str(error)))
        for message in bag.messages(writer.topics, damage):
            writer.write(message.topic, message.data, message.log_time, message.publish_time)
    return Repaired(writer.path, writer.message_count, tuple(damage))


def _left_out(topic: BagTopic, why: str) -> Fault:
    return Fault(f"{topic.name} is left out: {why}", topic.message_count)
