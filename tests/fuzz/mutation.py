"""Changes of a file that is whole: bits, cuts, repetitions, and numbers that stand at an edge."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from random import Random

__all__ = ["mutated"]

_LARGEST = 1 << 20  # bytes of a changed file

_WORDS = [
    *(b"0", b"-1", b"1", b"2", b"3", b"255", b"256", b"65535", b"65536", b"0.5", b"-0.0"),
    *(b"2147483647", b"-2147483648", b"2147483648", b"4294967295", b"4294967296"),
    *(b"9223372036854775807", b"-9223372036854775808", b"18446744073709551616"),
    *(b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-308", b"1e400", b"1e-30", b"9" * 400),
    *(
        b"",
        b":8",
        b"0x10",
        b"1_000",
        b"true",
        b"~",
        b"[]",
        b"{}",
        b"*a",
        b"&a",
        b"<<",
        b"\0",
        b"%s",
    ),
]
_EDGES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]
_LONG_EDGES = [*_EDGES, 0x100000000, 0x7FFFFFFFFFFFFFFF, 0x8000000000000000, 0xFFFFFFFFFFFFFFFF]
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?", re.IGNORECASE)


def mutated(seeds: Sequence[bytes], random: Random) -> bytes:
    """One of the seeds with one to eight changes."""
    content = bytearray(random.choice(seeds))
    for _ in range(random.choice((1, 1, 1, 2, 3, 8))):
        if content:
            random.choice(_CHANGES)(content, random, seeds)
    return bytes(content[:_LARGEST])


def _flip(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    content[random.randrange(len(content))] ^= 1 << random.randrange(8)


def _any_byte(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    content[random.randrange(len(content))] = random.randrange(256)


def _cut_end(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    del content[random.randrange(len(content)) :]


def _cut_out(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    at, length = _place(content, random)
    del content[at : at + length]


def _repeat(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    at, length = _place(content, random)
    times = random.choice((1, 1, 2, 50))
    content[at:at] = content[at : at + length] * times


def _overwrite(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    at, length = _place(content, random)
    content[at : at + length] = random.choice((bytes(length), b"\xff" * length))


def _splice(content: bytearray, random: Random, seeds: Sequence[bytes]) -> None:
    other = random.choice(seeds)
    if other:
        at, length = _place(bytearray(other), random)
        into = random.randrange(len(content))
        content[into : into + random.choice((0, length))] = other[at : at + length]


def _edge(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    width = random.choice((1, 2, 4, 8))
    at = random.randrange(len(content))
    value = random.choice(_EDGES if width < 8 else _LONG_EDGES) % (1 << (8 * width))
    content[at : at + width] = value.to_bytes(width, random.choice(("little", "little", "big")))


def _word(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    """Another number in a text; a file without any gets it anywhere."""
    begin = random.randrange(len(content))
    match = _NUMBER.search(content, begin) or _NUMBER.search(content)
    span = match.span() if match else (begin, begin)
    content[span[0] : span[1]] = random.choice(_WORDS)


def _lines(content: bytearray, random: Random, _: Sequence[bytes]) -> None:
    """Two lines change places, or one stands for the other."""
    lines = bytes(content).split(b"\n")
    a, b = random.randrange(len(lines)), random.randrange(len(lines))
    lines[a], lines[b] = lines[b], random.choice((lines[a], lines[b]))
    content[:] = b"\n".join(lines)


def _place(content: bytearray, random: Random) -> tuple[int, int]:
    """A byte and a length, mostly short."""
    at = random.randrange(len(content))
    return at, 1 + int(random.random() ** 4 * min(len(content) - at, 10_000))


_CHANGES: list[Callable[[bytearray, Random, Sequence[bytes]], None]] = [
    _flip,
    _any_byte,
    _cut_end,
    _cut_out,
    _repeat,
    _overwrite,
    _splice,
    _edge,
    _edge,
    _word,
    _word,
    _lines,
]
