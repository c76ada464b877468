"""Whether the header of an image file is that of a sequence of frames, or of one volume.

Plus leaves ``Seq_Frame0000_ImageStatus`` in the header of volumes that it has reconstructed, so
that a field of a frame alone says nothing.

>>> from us_sim.volume.files.frame_sequence import is_sequence
>>> is_sequence("domain domain domain", ["Seq_Frame0000_ImageStatus"])
False
>>> is_sequence("domain domain list", [])
True
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from us_sim.volume.files.metaimage import metaimage_header
from us_sim.volume.files.nrrd import nrrd_header

__all__ = ["FRAME_KEY", "holds_sequence", "is_sequence"]

_OVER_TIME = {"list", "time"}
FRAME_KEY = re.compile(r"Seq_Frame([0-9]{1,9})_(\w+)")
"""Keys of a frame's fields: its number, and the field's name."""


def is_sequence(kinds: str, keys: Iterable[str]) -> bool:
    """Whether a header is that of a sequence.

    Args:
        kinds: of its axes, as NRRD and Plus write them (``domain domain list``); may be empty,
            and then transforms of frames, or fields of several frames, make a sequence.
        keys: of the header.
    """
    if words := kinds.lower().split():
        return bool(_OVER_TIME & set(words))
    frames = [match for match in map(FRAME_KEY.fullmatch, keys) if match]
    described = {int(match[1]) for match in frames}
    return len(described) > 1 or any(match[2].endswith("Transform") for match in frames)


def holds_sequence(path: Path) -> bool:
    """The same of a MetaImage or NRRD file; other formats hold none.

    Raises:
        VolumeError: its header does not end.
    """
    name = path.name.lower()
    if name.endswith((".nrrd", ".nhdr")):
        fields, pairs, _ = nrrd_header(path)
        return is_sequence(fields.get("kinds", ""), pairs)
    if name.endswith((".mha", ".mhd")):
        header, _ = metaimage_header(path)
        return is_sequence(header.get("Kinds", ""), header)
    return False
