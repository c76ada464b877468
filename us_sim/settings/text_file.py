"""Reading the text files that a person names.

>>> from us_sim.settings.text_file import read_text
>>> read_text("/dev/zero")
Traceback (most recent call last):
    ...
OSError: [Errno 27] more than 64 MiB, and no text is so long: '/dev/zero'
"""

from __future__ import annotations

import errno
from pathlib import Path

_LARGEST = 64 << 20


def read_text(path: Path | str, encoding: str = "utf-8", errors: str = "strict") -> str:
    """The text of a file, or of a pipe, that is not endless.

    Raises:
        OSError: it cannot be read, or has more than 64 MiB.
        UnicodeDecodeError: it is no text of that encoding.
    """
    return read_bytes(path).decode(encoding, errors)


def read_bytes(path: Path | str) -> bytes:
    """Likewise, of a text whose encoding is said in it."""
    with Path(path).open("rb") as file:
        data = file.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise OSError(errno.EFBIG, "more than 64 MiB, and no text is so long", str(path))
    return data
