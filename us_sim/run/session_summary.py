"""A recorded session, its scene, and what is measured of it: counts, latency and lumen areas."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.errors import BagError
from us_sim.geometry.pose import Pose
from us_sim.nodes.sessions.attachments import file_checksum
from us_sim.recording.attached_files import extract_files
from us_sim.recording.decoding import SECOND, pixels_from, pose_from, tetrahedra_from, vectors_from
from us_sim.recording.reader import Bag, read_bag
from us_sim.run.session_tables import read_times
from us_sim.scene.building import build_scanner, load_volume
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.lumen import LumenMeter, find_lumen_labels
from us_sim.scoring.metrics import VesselSection
from us_sim.slicing.b_mode import BMode

IMAGE, POSE, NODES = "/ultrasound/image", "/probe/pose", "/tissue/nodes"
PLAYED = "/tracker/pose"
STAMPED = (PLAYED, POSE, NODES, "/skin/nodes", IMAGE)
REST, TETRAHEDRA, REPORTS = "/tissue/rest", "/tissue/tetrahedra", "/diagnostics"


@dataclass
class Session:
    """A recorded session, read once: everything but the images is kept."""

    bag: Bag
    poses: dict[int, Pose]  # by stamp, ns
    nodes: dict[int, NDArray[np.float64]]  # (N, 3) m by stamp, ns
    rest: NDArray[np.float64] | None  # (N, 3) m
    tetrahedra: NDArray[np.int32] | None  # (M, 4)
    times: dict[str, pd.DataFrame]  # of `STAMPED` topics, as of `read_times`
    reports: dict[str, dict[str, str]]  # last diagnostics by node

    def list_stamps(self, topic: str) -> list[int]:
        """List the stamps of a topic's messages, ns."""
        return self.times[topic]["stamp"].tolist() if topic in self.times else []

    def read_images(self, stamps: Collection[int]) -> dict[int, NDArray[np.uint8]]:
        """Read the images with those stamps, (rows, columns) each, in one pass."""
        messages = zip(self.list_stamps(IMAGE), self.bag.read_messages([IMAGE]), strict=True)
        return {
            stamp: pixels_from(self.bag.deserialize(message))
            for stamp, message in messages
            if stamp in stamps
        }

    def measure_lumens(
        self,
        scene: Scene,
        samples: int,
        progress: Callable[[float], None] = lambda _: None,
        lines: Mapping[str, CentreLine] | None = None,
    ) -> LumenMeter | None:
        """Measure vessels at up to ``samples`` images, and where they are along centre lines.

        There is None without labels or tissue.

        Raises:
            BagError: no image has its pose and nodes.
        """
        numbers, scanner = self.find_vessels(scene)
        if scanner is None:
            return None
        known = self.nodes.keys() & self.poses.keys()
        stamps = [each for each in self.list_stamps(IMAGE) if each in known]
        if not stamps:
            raise BagError(
                "the session holds no image with its pose and nodes, so nothing can be measured: "
                "look into nodes.log"
            )
        first = min(self.poses)
        meter = LumenMeter(numbers, scanner, self.rest, lines)
        picked = np.linspace(0, len(stamps) - 1, min(samples, len(stamps))).astype(int).tolist()
        for k, stamp in enumerate((stamps[at] for at in picked), 1):
            pose = self.poses[stamp]
            labels = scanner.render_labels(pose, self.nodes[stamp])
            meter.add_image((stamp - first) / SECOND, pose, labels)
            progress(k / len(picked))
        return meter

    def find_vessels(self, scene: Scene) -> tuple[dict[str, tuple[int, ...]], BMode | None]:
        """Find labels of vessels by their names, see `find_lumen_labels`, and the scanner for them.

        There is no scanner without labels of vessels, or without tissue.
        """
        volume = load_volume(scene)
        numbers = find_lumen_labels(volume.label_names)
        if volume.labels is None or not numbers or self.rest is None or self.tetrahedra is None:
            return {}, None
        scanner = build_scanner(scene, volume)
        scanner.attach_mesh(self.rest, self.tetrahedra)
        return numbers, scanner

    def summarize(self, sections: Mapping[str, VesselSection]) -> dict[str, Any]:
        """Sum all up as one JSON-like mapping; times in ms, areas in mm².

        A latency is the age of the pose when what followed from it was sent, or, ``end_to_end``,
        when its image had arrived at the recorder.

        Raises:
            BagError: the session has no image.
        """
        stamps = self.list_stamps(IMAGE)
        if not stamps:
            raise BagError(f"the session holds no image on {IMAGE}")
        poses = len(self.list_stamps(PLAYED))
        seconds = (stamps[-1] - stamps[0]) / SECOND
        latency = {t: _percentiles(self.times[t], "sent") for t in STAMPED[1:] if t in self.times}
        latency["end_to_end"] = _percentiles(self.times[IMAGE], "logged")
        return {
            "poses_in": poses,
            "images_out": len(stamps),
            "dropped": max(poses - len(stamps), 0),
            "images_per_second": (len(stamps) - 1) / seconds if seconds else 0.0,
            "latency_ms": latency,
            "nodes": self.reports,
            **({"areas": _summary_of(sections)} if sections else {}),
        }


def _percentiles(times: pd.DataFrame, until: str) -> dict[str, float]:
    p50, p99 = np.percentile((times[until] - times["stamp"]) * 1e-6, [50, 99]).tolist()
    return {"p50": p50, "p99": p99}


def _summary_of(sections: Mapping[str, VesselSection]) -> dict[str, Any]:
    section = next(iter(sections.values()))
    pressed = int(np.argmax(section.depth >= 0.99 * section.depth.max()))
    moments = {"at_full_press": pressed, "after_release": len(section.times) - 1}
    result: dict[str, Any] = {
        "time_s": section.times.round(4).tolist(),
        "depth_mm": (section.depth * 1e3).round(4).tolist(),
    }
    for name, section in sections.items():
        result[f"{name}_mm2"] = (section.area * 1e6).round(4).tolist()
        at_rest = (section.at_rest * 1e6).round(4)
        result[f"{name}_at_rest_mm2"] = [None if np.isnan(x) else float(x) for x in at_rest]
        for moment, sample in moments.items():
            change = float(section.fraction[sample] - 1.0)
            result[f"{name}_change_{moment}"] = None if np.isnan(change) else change
    return result


def read_session(file: Path, *further: Path) -> Session:
    """Read a session that `session_recorder` wrote, and those that went on with it.

    Raises:
        BagError: a file cannot be read.
    """
    bag = read_bag(file, *further)
    there = {topic.name for topic in bag.topics if topic.message_count}
    times = read_times(bag, sorted(there & {*STAMPED}))
    session = Session(bag, {}, {}, None, None, times, {})
    stamps = {topic: iter(session.list_stamps(topic)) for topic in (POSE, NODES)}
    for message in bag.read_messages(sorted(there & {POSE, NODES, REST, TETRAHEDRA, REPORTS})):
        content = bag.deserialize(message)
        if message.topic == POSE:
            session.poses[next(stamps[POSE])] = pose_from(content)
        elif message.topic == NODES:
            session.nodes[next(stamps[NODES])] = vectors_from(content)
        elif message.topic == REST:
            session.rest = vectors_from(content)
        elif message.topic == TETRAHEDRA:
            session.tetrahedra = tetrahedra_from(content)
        else:
            for status in content.status:
                report = {item.key: item.value for item in status.values}
                session.reports[status.name.rsplit("/", 1)[-1]] = report
    return session


@contextlib.contextmanager
def unpack_scene(bag: Bag) -> Iterator[Scene]:
    """Unpack the scene that is attached to a session, for a while.

    Raises:
        BagError: there is none, or a file of it that was too large to be attached is another now.
        UsSimError: a file cannot be read or written.
    """
    attached = bag.attachments
    if "scene.yaml" not in attached:
        raise BagError(
            f"{bag.path} has no scene attached: name the scene, and play it with "
            f"`us-sim render SCENE --path {bag.path}`"
        )
    with tempfile.TemporaryDirectory(prefix="us_sim_session_") as folder:
        unpacked = extract_files(bag.path, Path(folder))
        listed = attached["files.txt"].data.decode() if "files.txt" in attached else ""
        there = {file_checksum(file) for file in unpacked}
        for digest, _, name in (line.partition("  ") for line in listed.splitlines()):
            if digest not in there and file_checksum(Path(name)) != digest:
                raise BagError(
                    f"{name} is not the file that {bag.path} was recorded with, and was too large "
                    f"to be attached: bring that one back"
                )
        yield load_scene(Path(folder, "scene.yaml"))
