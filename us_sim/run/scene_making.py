"""Makes what a scene needs before its nodes are started, and tells how far it is.

As a program: ``python -m us_sim.run.scene_making SCENE [VOLUME]``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from us_sim.errors import UsSimError
from us_sim.run.background import tell
from us_sim.scene.building import volume_of
from us_sim.scene.case_tissue import keep_tissue
from us_sim.scene.reading import load_scene

_STEP_S = 0.1


def main(name: str, volume: str = "") -> int:
    """Make the volume and the tissue; a phantom and a case's tissue are kept."""
    try:
        scene = load_scene(name, volume=volume or None)
        what = f"making {scene.volume.name}" if scene.volume.phantom else "reading the volume"
        tell(fraction=0.0, text=what)
        read = volume_of(scene, _telling(what))
        keep_tissue(scene, read, _telling("making the tissue"))
    except UsSimError as error:
        tell(refused=str(error))
        return 1
    except MemoryError:
        tell(refused=f"{name}: there is not enough memory")
        return 1
    tell(ready=True)
    return 0


def _telling(what: str) -> Callable[[float, str], None]:
    """Tells a fraction from time to time."""
    told = 0.0

    def show(fraction: float, _: str) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told > _STEP_S:
            told = now
            tell(fraction=fraction, text=what)

    return show


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
