"""XXH3 with 128 bits, of texts of more than 16 bytes: rmw_zenoh makes gids of it.

The specification is https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md. It is written
for clearness, not speed: some 40 µs for a liveliness token.
"""

from __future__ import annotations

import struct

_MASK = 2**64 - 1
_P32_1, _P32_2, _P32_3 = 0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D
_P64_1, _P64_2, _P64_3 = 0x9E3779B185EBCA87, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9
_P64_4, _P64_5 = 0x85EBCA77C2B2AE63, 0x27D4EB2F165667C5

# The default secret of the specification.
_SECRET = bytes.fromhex(
    "b8fe6c3923a44bbe7c01812cf721ad1cded46de9839097db7240a4a4b7b3671f"
    "cb79e64eccc0e578825ad07dccff7221b8084674f743248ee03590e6813a264c"
    "3c2852bb91c300cb88d0658b1b532ea371644897a20df94e3819ef46a9deacd8"
    "a8fa763fe39c343ff9dcbbc7c70b4f1d8a51e04bcdb45931c89f7ec9d9787364"
    "eac5ac8334d3ebc3c581a0fffa1363eb170ddd51b7f0da49d316552629d4689e"
    "2b16be587d47a1fc8ff8b8d17ad031ce45cb3a8f95160428afd7fbcabb4b407e"
)
_STRIPE, _STEP = 64, 8
_STRIPES = (len(_SECRET) - _STRIPE) // _STEP  # in a block


def xxh3_128(data: bytes) -> bytes:
    """The hash of more than 16 bytes: 16 bytes, the lower half first, each little-endian.

    >>> xxh3_128(b"The quick brown fox jumps over the lazy dog").hex()
    '51768a3a2ecca124fae7a35c2050d6dd'
    """
    low, high = _medium(data) if len(data) <= 240 else _long(data)
    return struct.pack("<QQ", low, high)


def _words(data: bytes, start: int, number: int) -> tuple[int, ...]:
    return struct.unpack_from(f"<{number}Q", data, start)


def _folded(first: int, second: int) -> int:
    product = first * second
    return (product ^ (product >> 64)) & _MASK


def _avalanche(value: int) -> int:
    value ^= value >> 37
    value = value * 0x165667919E3779F9 & _MASK
    return value ^ (value >> 32)


def _medium(data: bytes) -> tuple[int, int]:
    """Lengths of 17 to 240."""
    size = len(data)
    low, high = size * _P64_1 & _MASK, 0

    def mix(first: int, second: int, secret: int) -> None:
        nonlocal low, high
        (a, b), (c, d) = _words(data, first, 2), _words(data, second, 2)
        s, t, u, v = _words(_SECRET, secret, 4)
        low = (low + _folded(a ^ s, b ^ t) & _MASK) ^ (c + d & _MASK)
        high = (high + _folded(c ^ u, d ^ v) & _MASK) ^ (a + b & _MASK)

    if size <= 128:
        for part in reversed(range((size - 1) // 32 + 1)):
            mix(16 * part, size - 16 * (part + 1), 32 * part)
    else:
        for part in range(4):
            mix(32 * part, 32 * part + 16, 32 * part)
        low, high = _avalanche(low), _avalanche(high)
        for part in range(4, size // 32):
            mix(32 * part, 32 * part + 16, 3 + 32 * (part - 4))
        mix(size - 16, size - 32, 136 - 17 - 16)
    mixed = low * _P64_1 + high * _P64_4 + size * _P64_2
    return _avalanche(low + high & _MASK), -_avalanche(mixed & _MASK) & _MASK


def _long(data: bytes) -> tuple[int, int]:
    lanes = [_P32_3, _P64_1, _P64_2, _P64_3, _P64_4, _P32_2, _P64_5, _P32_1]

    def accumulate(start: int, secret: int) -> None:
        keys = _words(_SECRET, secret, 8)
        for lane, value in enumerate(_words(data, start, 8)):
            keyed = value ^ keys[lane]
            lanes[lane ^ 1] += value
            lanes[lane] += (keyed & 0xFFFFFFFF) * (keyed >> 32)

    last = len(_SECRET) - _STRIPE
    for stripe in range((len(data) - 1) // _STRIPE):
        accumulate(stripe * _STRIPE, stripe % _STRIPES * _STEP)
        if stripe % _STRIPES == _STRIPES - 1:
            for lane, key in enumerate(_words(_SECRET, last, 8)):
                value = lanes[lane] & _MASK
                lanes[lane] = (value ^ (value >> 47) ^ key) * _P32_1
    accumulate(len(data) - _STRIPE, last - 7)

    def merged(secret: int, start: int) -> int:
        keys = _words(_SECRET, secret, 8)
        words = [lane & _MASK ^ key for lane, key in zip(lanes, keys, strict=True)]
        total = start + sum(map(_folded, words[::2], words[1::2]))
        return _avalanche(total & _MASK)

    low = merged(11, len(data) * _P64_1)
    return low, merged(len(_SECRET) - _STRIPE - 11, ~(len(data) * _P64_2))
