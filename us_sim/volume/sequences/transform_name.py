"""Names of transforms as Plus reads them: the frame whose points are taken, ``To``, the frame they
are given in.

Plus (IGSIO, igsioTransformName::SetTransformName) splits a name at the one ``To`` whose next
character is no lower-case letter, so that a body may be called ``Tool`` or ``Torso``.

>>> from us_sim.volume.sequences.transform_name import split_transform_name
>>> split_transform_name("TestToolToTracker"), split_transform_name("ToolTip")
(('TestTool', 'Tracker'), None)
"""

from __future__ import annotations

import re

_TO = re.compile(r"To(?=[^a-z])")


def split_transform_name(name: str) -> tuple[str, str] | None:
    """The frames that a transform leads from and to; None for what names no transform.

    Frames begin with a capital letter, as Plus makes them.
    """
    found = list(_TO.finditer(name))
    if len(found) != 1 or not found[0].start():
        return None
    start, end = name[: found[0].start()], name[found[0].end() :]
    return start[0].upper() + start[1:], end[0].upper() + end[1:]


def is_image_frame(frame: str) -> bool:
    """Whether a frame is an image's, whose coordinates are pixels and not millimetres."""
    return frame.startswith("Image") or frame.endswith("Image")
