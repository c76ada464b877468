"""A recording's content for a person: what `us-sim bag info` prints."""

from __future__ import annotations

from datetime import UTC, datetime

from us_sim.errors import printable
from us_sim.recording.reader import Bag


def describe(bag: Bag) -> str:
    """Path, times, topics with type, count, rate and offered quality; then losses, marks, files.

    The times of marks are those since the start.
    """
    summary = bag.summary()
    seconds = summary["duration"] * 1e-9
    lines = [f"file      {summary['path']}"]
    lines += [f"note      {fault['text']}" for fault in summary["faults"]]
    if summary["start"] is not None:
        lines.append(f"start     {_date(summary['start'])}")
    lines += [f"duration  {seconds:.3f} s", f"messages  {summary['message_count']}", ""]
    table = [("topic", "type", "count", "Hz", "quality of service")]
    for topic in summary["topics"]:
        count = topic["message_count"]
        rate = f"{(count - 1) / seconds:.1f}" if seconds and count > 1 else "-"
        quality = "; ".join(dict.fromkeys(topic["qos"])) or "-"
        encoding = "" if topic["encoding"] == "cdr" else f" ({topic['encoding']})"
        table.append((topic["name"], topic["type"] + encoding, str(count), rate, quality))
    widths = [max(len(row[i]) for row in table) for i in range(4)]
    for name, kind, count, rate, quality in table:
        lines.append(
            f"{name:<{widths[0]}}  {kind:<{widths[1]}}  {count:>{widths[2]}}  "
            f"{rate:>{widths[3]}}  {quality}"
        )
    lines += _section("lost", [f"{count} of {topic}" for topic, count in summary["lost"].items()])
    lines += _section(
        "marked",
        [
            f"{(mark['time'] - (summary['start'] or mark['time'])) * 1e-9:.3f} s  {mark['text']}"
            for mark in summary["markers"]
        ],
    )
    lines += _section(
        "attached",
        [f"{each['name']} ({each['size']} bytes)" for each in summary["attachments"]],
    )
    return "\n".join(printable(line) for line in lines)


def _section(title: str, entries: list[str]) -> list[str]:
    """Lines under a title, or none."""
    return ["", title, *(f"  {entry}" for entry in entries)] if entries else []


def _date(nanoseconds: int) -> str:
    """A time since the epoch as a person reads it; as it is where no calendar has it."""
    try:
        date = datetime.fromtimestamp(nanoseconds * 1e-9, tz=UTC)
    except (ValueError, OverflowError, OSError):
        return f"{nanoseconds} ns"
    return date.isoformat(timespec="milliseconds")
