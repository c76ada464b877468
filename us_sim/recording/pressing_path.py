"""Files with the demo's path, as a case asks for it; made once and kept in the cache.

>>> import os, tempfile
>>> from us_sim.recording.path import read_path
>>> from us_sim.recording.pressing_path import pressing_path
>>> with tempfile.TemporaryDirectory() as os.environ["US_SIM_CACHE"]:
...     path = read_path(pressing_path(7e-3))
>>> float(path.positions[:, 2].max())
0.007
>>> del os.environ["US_SIM_CACHE"]
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from us_sim.cache import cache_folder
from us_sim.errors import BagError
from us_sim.recording.path import write_path
from us_sim.recording.press_and_slide import press_and_slide

_MADE = 1
"""Changes with what `press_and_slide` makes, so that no older file is taken for it."""


def pressing_path(depth: float, slide: float = 0.008) -> Path:
    """The file of `press_and_slide` with that depth and slide (m), to a tenth of a millimetre.

    Raises:
        BagError: the cache folder cannot be written.
    """
    name = f"press-{_MADE}-{depth * 1e3:.1f}-mm-slide-{slide * 1e3:.1f}-mm.mcap"
    file = cache_folder() / name
    if file.is_file():
        return file
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{file.name}.", dir=file.parent) as folder:
            partial = Path(folder, file.name)
            path = press_and_slide(depth=round(depth, 4), slide=round(slide, 4))
            write_path(partial, path, sidecar=False)
            os.replace(partial, file)
    except OSError as error:
        raise BagError(
            f"{file}: the path of the press cannot be kept ({error.strerror}): set US_SIM_CACHE to "
            f"a folder that can be written"
        ) from error
    return file
