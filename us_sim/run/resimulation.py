"""A session simulated again from its recording alone: its scene, parameters and poses.

What the recording does not hold is checked: files that were too large to be attached by their
checksums, and the versions of whatever computes. Parameters that were set while it ran are in no
recording; those of its start are used.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from us_sim.errors import BagError
from us_sim.nodes.sessions.attachments import checksum, parts_of
from us_sim.recording.path import write_path
from us_sim.recording.reader import Bag, read_bag
from us_sim.recording.repair import extract, versions
from us_sim.recording.topic import BagAttachment
from us_sim.run.plan import Parameters, Request, simulation_nodes
from us_sim.scene.building import path_of
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene
from us_sim.settings.text_files import YamlError, load_yaml

_OF_THE_RUN = {"scene", "volume", "source"}
"""Parameters that the run sets by itself."""
_COMPUTING = (
    *("us_sim", "us_sim_code", "python", "byte order", "numpy", "scipy", "numba", "llvmlite"),
    *("opencv-python-headless", "opencv-python", "SimpleITK", "pydicom"),
)
"""Entries of `versions.txt` that can change an image."""


def resimulation(session: Path, folder: Path, volume: Path | None = None) -> tuple[Request, str]:
    """Return what simulates a session again, and a sentence on what may make images differ.

    Args:
        session: its recording.
        folder: gets the files that are attached and the poses as a bag, and must stay until the
            simulation has ended; empty.
        volume: where the scene's volume is now.

    Raises:
        BagError: the session has no scene or poses, or a file of the scene is missing or another.
        UsSimError: a file cannot be read or written.
    """
    bag = read_bag(session)
    scene = _unpack_scene(bag, folder / "attached", volume)
    path, poses = path_of(scene, session), folder / "poses.mcap"
    write_path(poses, path, sidecar=False)
    attached = bag.attachments()
    parameters = _parameters(session, attached, scene)
    if path.topic.endswith("/probe/pose"):  # the filter has had its say
        parameters.setdefault("probe_tracker", {})["filter"] = "none"
    scene = replace(scene, path=str(poses))
    request = Request(scene, parameters, path=poses, topic=path.topic)
    return request, _other_versions(session, attached)


@contextlib.contextmanager
def scene_of(bag: Bag) -> Iterator[Scene]:
    """Unpack the scene that is attached to a session, for a while.

    Raises:
        BagError, UsSimError: as of `resimulation`.
    """
    with tempfile.TemporaryDirectory(prefix="us_sim_session_") as folder:
        yield _unpack_scene(bag, Path(folder, "attached"))


def _unpack_scene(bag: Bag, folder: Path, volume: Path | None = None) -> Scene:
    """Read the scene that is attached, after its files were unpacked into a new folder."""
    attached = bag.attachments()
    if "scene.yaml" not in attached:
        raise BagError(
            f"{bag.path} has no scene attached: name the scene, and play it with "
            f"`us-sim render SCENE --path {bag.path}`"
        )
    _require_files(bag.path, attached, volume)
    extract(bag.path, folder)
    return load_scene(folder / "scene.yaml", volume=volume)


def _text(attached: Mapping[str, BagAttachment], name: str) -> str:
    return attached[name].data.decode("utf-8", "replace") if name in attached else ""


def _require_files(
    session: Path, attached: Mapping[str, BagAttachment], volume: Path | None
) -> None:
    """Refuse files of the scene that are neither attached nor as they were."""
    held = {hashlib.sha256(each.data).hexdigest() for each in attached.values()}
    lines = [line.partition("  ") for line in _text(attached, "files.txt").splitlines()]
    recorded = {Path(name): digest for digest, _, name in lines}
    if volume is not None:
        now = {checksum(part) for part in parts_of(volume)}
        if not now <= set(recorded.values()):
            raise BagError(
                f"--volume {volume} is not the volume that {session} was recorded with: its "
                f"SHA-256 is none of those in files.txt of the recording; name that one"
            )
        held |= now
    for path, digest in recorded.items():
        if digest in held or not digest.strip("-"):
            continue
        found = checksum(path)
        if not found.strip("-"):
            raise BagError(
                f"{session} needs {path}, which was too large to be attached and is not there: "
                f"bring it back, or say with --volume where it is if it is the volume"
            )
        if found != digest:
            raise BagError(
                f"{path} is not the file that {session} was recorded with (SHA-256 "
                f"{found[:12]}… where {digest[:12]}… was): bring that one back"
            )


def _parameters(session: Path, attached: Mapping[str, BagAttachment], scene: Scene) -> Parameters:
    """Return the recorded parameters of the nodes that run again."""
    try:
        document = load_yaml(_text(attached, "parameters.yaml")) or {}
        return {
            process.node: {
                name: json.dumps(value)
                for name, value in document[process.node]["ros__parameters"].items()
                if name not in _OF_THE_RUN
            }
            for process in simulation_nodes(scene, played=True)
            if process.node in document
        }
    except (YamlError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise BagError(
            f"{session} has a parameters.yaml that holds no parameters of nodes: {error}"
        ) from None


def _other_versions(session: Path, attached: Mapping[str, BagAttachment]) -> str:
    """Return a sentence on versions that are others than those of the session; empty if none."""

    def by_name(text: str) -> dict[str, str]:
        lines = (line.rpartition(" ") for line in text.splitlines())
        return {name: version for name, _, version in lines}

    then, now = by_name(_text(attached, "versions.txt")), by_name(versions())
    if not any(name in then for name in _COMPUTING):
        return f"{session} does not say with which versions it was made, so images may differ"
    other = [
        f"{name} {then.get(name, 'none')[:12]} (now {now.get(name, 'none')[:12]})"
        for name in _COMPUTING
        if then.get(name) != now.get(name)
    ]
    return f"{session} was made with {', '.join(other)}: images may differ" if other else ""
