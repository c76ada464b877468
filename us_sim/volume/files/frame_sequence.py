"""Whether the header of an image file is that of a sequence of frames, or of one volume.

Plus leaves ``Seq_Frame0000_ImageStatus`` in the header of volumes that it has reconstructed, so
that a field of a frame alone says nothing.

>>> from us_sim.volume.files.frame_sequence import is_sequence
>>> is_sequence("domain domain domain", ["Seq_Frame0000_ImageStatus"])
False
>>> is_sequence("domain domain list", []), is_sequence("list domain domain domain", [])
(True, False)
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from us_sim.volume.files.metaimage import metaimage_header
from us_sim.volume.files.nrrd import nrrd_header

_OVER_TIME = {"list", "time"}
FRAME_KEY = re.compile(r"Seq_Frame([0-9]{1,9})_(\w+)")
"""Keys of a frame's fields: its number, and the field's name."""


def is_sequence(kinds: str, keys: Iterable[str]) -> bool:
    """Whether a header is that of a sequence.

    Args:
        kinds: of its axes, as NRRD and Plus write them (``domain domain list``), of which the last
            one counts: a list that comes first is the layers of a segmentation. They may be empty,
            and then transforms of frames, or fields of several frames, make a sequence.
        keys: of the header.
    """
    if words := kinds.lower().split():
        return words[-1] in _OVER_TIME
    frames = [match for match in map(FRAME_KEY.fullmatch, keys) if match]
    described = {int(match[1]) for match in frames}
    return len(described) > 1 or any(match[2].endswith("Transform") for match in frames)


def sequence_remedy(path: Path) -> str | None:
    """What a MetaImage or NRRD file of a sequence is, and what can be made of it; None of others.

    Raises:
        VolumeError: its header does not end.
    """
    name = path.name.lower()
    if name.endswith((".nrrd", ".nhdr")):
        fields, keys, _ = nrrd_header(path)
        kinds, sizes = fields.get("kinds", ""), fields.get("sizes", "").split()
    elif name.endswith((".mha", ".mhd")):
        keys, _ = metaimage_header(path)
        kinds, sizes = keys.get("Kinds", ""), keys.get("DimSize", "").split()
    else:
        return None
    if not is_sequence(kinds, keys) or (len(sizes) == 4 and sizes[2] != "1" and sizes[0] != "0"):
        return None  # several volumes in time are no sequence of flat images
    tracked = any(match and match[2].endswith("Transform") for match in map(FRAME_KEY.match, keys))
    if "0" in sizes:
        return f"a recording of poses without images; play it with `--path {path.name}`"
    if not tracked:
        return "a sequence of images without poses; record it again with a tracked probe"
    return (
        f"a sequence of tracked frames; make a volume of it with `us-sim reconstruct {path.name} "
        f"--out volume.nrrd`"
    )
