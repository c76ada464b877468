"""Every field of every kind of record is changed: what is told to be lost is what is lost."""

import struct
from collections import Counter

import pytest
from mcap.opcode import Opcode

from us_sim.recording.mcap_records import HEADER
from us_sim.recording.reader import read_bag
from us_sim.recording.repair import repair
from us_sim.recording.writer import BagWriter

EPOCH = 1_700_000_000_000_000_000
FIELDS = {
    Opcode.HEADER: "ss",
    Opcode.FOOTER: "QQI",
    Opcode.SCHEMA: "Hsss",
    Opcode.CHANNEL: "HHssm",
    Opcode.MESSAGE: "HIQQ*",
    Opcode.CHUNK: "QQQIsb",
    Opcode.MESSAGE_INDEX: "HIQQ",
    Opcode.CHUNK_INDEX: "QQQQIHQ",
    Opcode.ATTACHMENT: "QQssbI",
    Opcode.ATTACHMENT_INDEX: "QQQQQss",
    Opcode.STATISTICS: "QHIIIIQQ",
    Opcode.METADATA: "sm",
    Opcode.METADATA_INDEX: "QQs",
    Opcode.SUMMARY_OFFSET: "BQQ",
    Opcode.DATA_END: "I",
}
"""Numbers as `struct` names them; s, m and b: text, mapping, bytes after their length; *: rest."""


def fields(content, begin):
    """Kind, offset and length of each field of the records from there on, of chunks' too."""
    while begin < len(content) - 8:
        opcode, length = HEADER.unpack_from(content, begin)
        yield opcode, begin, 1
        yield opcode, begin + 1, 8
        at, end = begin + HEADER.size, begin + HEADER.size + length
        for form in FIELDS[Opcode(opcode)]:
            if form == "*":
                yield opcode, at, 1
                continue
            size = struct.calcsize({"s": "I", "m": "I", "b": "Q"}.get(form, form))
            yield opcode, at, size
            if form in "smb":
                held = int.from_bytes(content[at : at + size], "little")
                if held:
                    yield opcode, at + size, 1
                    yield opcode, at + size + held - 1, 1
                if opcode == Opcode.CHUNK and form == "b" and content[at + size] == Opcode.SCHEMA:
                    yield from fields(content[: at + size + held] + bytes(8), at + size)
                at += held
            at += size
        begin = end


@pytest.mark.parametrize(
    ("compression", "indexed", "kinds"),
    [("none", True, len(FIELDS)), ("zstd", True, 14), ("none", False, 8), ("zstd", False, 7)],
)
def test_what_is_told_is_what_is_lost(tmp_path, compression, indexed, kinds):
    file = tmp_path / "session.mcap"
    with BagWriter(file, compression=compression, chunk_size=300, sidecar=False) as bag:
        for topic in ("/a", "/b"):
            bag.add_topic(topic, "std_msgs/msg/UInt8")
        bag.attach("scene.yaml", "text/yaml", b"acoustics: live", EPOCH)
        for k in range(20):
            bag.write("/b" if k % 4 == 0 else "/a", bytes([0, 1, 0, 0, k]), EPOCH + k * 10**7)
            if k == 10:
                bag.note("marker", {"time": str(EPOCH), "text": "needle in"})
    content = file.read_bytes()
    if not indexed:
        content = content[: content.rindex(HEADER.pack(Opcode.DATA_END, 4))]
        file.write_bytes(content)
    whole = read_bag(file)
    messages, attached = Counter(whole.messages()), whole.attachments()
    assert (messages.total(), [*attached]) == (20, ["scene.yaml"])
    said = whole.faults()
    assert sum(fault.messages for fault in said) == 0
    seen = set()
    for opcode, at, size in fields(content + bytes(0 if indexed else 8), 8):
        seen.add(opcode)
        field = content[at : at + size]
        for changed in (field[:-1] + bytes([field[-1] ^ 128]), bytes([field[0] ^ 1]) + field[1:]):
            file.write_bytes(content[:at] + changed + content[at + size :])
            bag = read_bag(file)
            faults = bag.faults()
            read = Counter(bag.messages(damage=[]))
            told = sum(fault.messages for fault in faults)
            where = (Opcode(opcode).name, at, field, changed, [fault.text for fault in faults])
            assert not read - messages, where
            assert told == (messages - read).total(), where
            assert len(faults) > len(said) or not told, where
            held = bag.attachments([])
            assert held == attached or len(faults) > len(said), where
    assert len(seen) == kinds
    assert repair(file, tmp_path / "whole").message_count == read.total()
