"""Volume and tissue of a scene, made and kept before its nodes need them.

As a program, ``python -m us_sim.run.preparation SCENE [VOLUME]``, it makes them beside a running
simulation, and tells the process that started it how far it is: a JSON mapping a line.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from us_sim.errors import UsSimError
from us_sim.progress import late_progress
from us_sim.run.processes import LIFELINE, child_environment
from us_sim.scene.building import volume_of
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene


def prepare_scene(
    scene: Scene,
    path: Path | None = None,
    topic: str | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> None:
    """Make a phantom that is not in the cache yet, in view of the person who waits.

    The tissue of a case is made too, and kept in the case. Of a phantom that is there nothing is
    read, unless a path is played: its nodes do that, and notice damage.

    Args:
        scene: whose volume is made.
        path: that will be played.
        topic: of the body in it.
        progress: told the fraction done and of what; None shows a bar once a second has passed.

    Raises:
        UsSimError: the volume cannot be read, or no image along the path shows any of it.
    """
    phantom = scene.volume.phantom
    if path is None and phantom is not None:
        from us_sim.volume.phantom.phantom import is_phantom_kept

        if is_phantom_kept(phantom, scene.volume.seed, scene.volume.voxel_size):
            return
    volume = volume_of(scene, progress or late_progress(f"making {scene.volume.name}"))
    if path is not None:
        from us_sim.scene.placement import check_path_in_volume

        check_path_in_volume(scene, path, volume, topic)
    if scene.volume.case is not None:
        from us_sim.scene.case_tissue import keep_tissue

        keep_tissue(scene, volume)


class Preparation:
    """A scene that is prepared in another process.

    Args:
        name: of the scene, or its file.
        volume: in place of the scene's.
    """

    def __init__(self, name: str, volume: str | None) -> None:
        self.name, self.volume = name, volume
        self.fraction, self.step = 0.0, "reading the scene"
        self.refusal = f"{name}: what prepares it ended without a word"
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, name, *filter(None, [volume])],
            stdin=LIFELINE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=child_environment(),
            start_new_session=True,
        )
        assert self._process.stdout is not None
        self._output = self._process.stdout
        os.set_blocking(self._output.fileno(), False)

    def has_ended(self) -> bool:
        """Read how far it is; return whether it is done, or refused."""
        has_ended = self._process.poll() is not None  # before the rest is read
        for line in self._output.readlines():
            for name, value in json.loads(line).items():
                setattr(self, name, value)
        return has_ended

    def end(self) -> None:
        """End it, whatever it does."""
        self._process.kill()
        self._process.wait()
        self._output.close()


def main(name: str, volume: str | None = None) -> None:
    """Prepare a scene, at a lower priority than what runs."""
    with contextlib.suppress(AttributeError):  # Windows
        os.nice(2)
    told = 0.0

    def show(fraction: float, _: str) -> None:
        nonlocal told
        if time.monotonic() - told > 0.1:
            told = time.monotonic()
            _tell(fraction=fraction)

    try:
        scene = load_scene(name, volume=volume)
        made = f"making {scene.volume.name}" if scene.volume.phantom else "reading the volume"
        _tell(step=made)
        prepare_scene(scene, progress=show)
        _tell(refusal="")
    except UsSimError as error:
        _tell(refusal=str(error))
    except MemoryError:
        _tell(refusal=f"{name}: there is not enough memory")


def _tell(**values: object) -> None:
    print(json.dumps(values), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
