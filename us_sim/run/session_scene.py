"""The scene that is attached to a session, with its files as they were."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from us_sim.errors import BagError
from us_sim.nodes.sessions.attachments import checksum
from us_sim.recording.reader import Bag
from us_sim.recording.repair import extract
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene


@contextlib.contextmanager
def scene_of(bag: Bag) -> Iterator[Scene]:
    """Unpack the scene that is attached to a session, for a while.

    Raises:
        BagError: there is none, or a file of it that was too large to be attached is another now.
        UsSimError: a file cannot be read or written.
    """
    attached = bag.attachments()
    if "scene.yaml" not in attached:
        raise BagError(
            f"{bag.path} has no scene attached: name the scene, and play it with "
            f"`us-sim render SCENE --path {bag.path}`"
        )
    with tempfile.TemporaryDirectory(prefix="us_sim_session_") as folder:
        unpacked = extract(bag.path, Path(folder))
        listed = attached["files.txt"].data.decode() if "files.txt" in attached else ""
        there = {checksum(file) for file in unpacked}
        for digest, _, name in (line.partition("  ") for line in listed.splitlines()):
            if digest not in there and checksum(Path(name)) != digest:
                raise BagError(
                    f"{name} is not the file that {bag.path} was recorded with, and was too large "
                    f"to be attached: bring that one back"
                )
        yield load_scene(Path(folder, "scene.yaml"))
