"""Writes the probe paths that the project ships, as ``python -m`` of the module that makes one.

>>> from us_sim.recording.press_and_slide import press_and_slide
>>> from us_sim.recording.shipped_path import write_where_asked
>>> write_where_asked([], "us_sim.recording.press_and_slide", press_and_slide)
2
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from us_sim.errors import BagError
from us_sim.recording.path import ProbePath, write_path


def write_where_asked(arguments: Sequence[str], module: str, make: Callable[[], ProbePath]) -> int:
    """Write a path to the file that the one argument names.

    Args:
        arguments: of the command line.
        module: its name, for the usage.
        make: the path.

    Returns:
        The exit status: 0, 1 where the file cannot be written, 2 for other arguments than one.
    """
    if len(arguments) != 1:
        print(f"usage: python -m {module} FILE.mcap", file=sys.stderr)
        return 2
    try:
        # The folder of the project's paths holds one bag per file, so none may claim it.
        write_path(arguments[0], make(), sidecar=False)
    except BagError as error:
        print(error, file=sys.stderr)
        return 1
    return 0
