"""A recorded session measured: counts, latency, lumen areas, and the error of a tracked path."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import BagError
from us_sim.geometry.pose import Pose
from us_sim.nodes.topics import published_counts
from us_sim.recording.decoding import pixels_from, pose_from, tetrahedra_from, vectors_from
from us_sim.recording.reader import Bag, read_bag
from us_sim.run.camera_video import PathVideo
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scene.scene import Scene
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.lumen import LumenAreas, LumenMeter, lumens_of
from us_sim.slicing.b_mode import BMode
from us_sim.tracking.camera.body_pose import rotation_angle

PLAYED = ("/tracker/pose", "/camera/camera_info")  # what comes in, of a path and of a camera
STAMPED = (*PLAYED, "/probe/pose", "/tissue/nodes", "/skin/nodes", "/ultrasound/image")
OTHERS = ("/tissue/rest", "/tissue/tetrahedra", "/diagnostics")
MILLISECOND = 1e6  # in nanoseconds


@dataclass(frozen=True)
class Session:
    """A recorded session, read once: everything but the images is kept."""

    bag: Bag
    poses: dict[int, Pose]  # by stamp, ns
    nodes: dict[int, NDArray[np.float64]]  # (N, 3) m by stamp, ns
    rest: NDArray[np.float64] | None  # (N, 3) m
    tetrahedra: NDArray[np.int32] | None  # (M, 4)
    sent: dict[str, list[tuple[int, int, int]]]  # topic: (stamp, publish time, log time), ns
    reports: dict[str, dict[str, str]]  # last diagnostics by node

    @property
    def images(self) -> list[int]:
        """Stamps of the images, ns."""
        return [stamp for stamp, _, _ in self.sent.get("/ultrasound/image", [])]

    def latency(self, topic: str) -> tuple[float, float]:
        """Age of the pose when ``topic`` was published, ms: median and 99th percentile."""
        return _percentiles([sent - stamp for stamp, sent, _ in self.sent[topic]])

    def end_to_end(self) -> tuple[float, float]:
        """Age of the pose when its image had arrived at the recorder, ms: median, 99th percentile.

        Raises:
            BagError: the session has no image.
        """
        rows = self.sent.get("/ultrasound/image", [])
        if not rows:
            raise BagError("the session holds no image on /ultrasound/image")
        return _percentiles([logged - stamp for stamp, _, logged in rows])

    def images_at(self, stamps: Collection[int]) -> dict[int, NDArray[np.uint8]]:
        """The images with those stamps, (rows, columns) each, read in one pass.

        Raises:
            BagError: there is none with one of the stamps.
        """
        found: dict[int, NDArray[np.uint8]] = {}
        for message in self.bag.messages(["/ultrasound/image"]):
            decoded: Any = self.bag.deserialize(message)
            if _stamp(decoded) in stamps:
                found[_stamp(decoded)] = pixels_from(decoded)
        for stamp in stamps:
            if stamp not in found:
                raise BagError(f"the session has no image with stamp {stamp}")
        return found

    def lumen_areas(
        self, scene: Scene, samples: int, progress: Callable[[float], None] | None = None
    ) -> LumenAreas | None:
        """Vessel cross-sections at up to ``samples`` images; None without labels or tissue."""
        meter = self.measured_lumens(scene, samples, progress)
        return meter.areas() if meter is not None else None

    def measured_lumens(
        self,
        scene: Scene,
        samples: int,
        progress: Callable[[float], None] | None = None,
        lines: Mapping[str, CentreLine] | None = None,
    ) -> LumenMeter | None:
        """Likewise, with centre lines of the vessels for their places.

        Raises:
            BagError: no image has its pose and nodes.
        """
        numbers, scanner = self.scanner_of_vessels(scene)
        if scanner is None:
            return None
        stamps = [stamp for stamp in self.images if stamp in self.nodes and stamp in self.poses]
        if not stamps:
            raise BagError(
                "the session holds no image with its pose and nodes, so nothing can be measured: "
                "look into nodes.log"
            )
        first = min(self.poses)
        meter = LumenMeter(numbers, scanner, self.rest, lines)
        picked = np.linspace(0, len(stamps) - 1, min(samples, len(stamps))).astype(int).tolist()
        for k, at in enumerate(picked, 1):
            stamp = stamps[at]
            pose = self.poses[stamp]
            meter.add((stamp - first) * 1e-9, pose, scanner.labels(pose, self.nodes[stamp]))
            if progress is not None:
                progress(k / len(picked))
        return meter

    def scanner_of_vessels(self, scene: Scene) -> tuple[dict[str, tuple[int, ...]], BMode | None]:
        """Labels of vessels by their names, see `lumens_of`, and the scanner that finds them.

        There is no scanner without labels of vessels, or without tissue.
        """
        volume = volume_of(scene)
        numbers = lumens_of(volume.label_names)
        if volume.labels is None or not numbers or self.rest is None or self.tetrahedra is None:
            return {}, None
        scanner = scanner_of(scene, volume)
        scanner.carry(self.rest, self.tetrahedra)
        return numbers, scanner

    def summary(self, areas: LumenAreas | None) -> dict[str, Any]:
        """Everything as one JSON-like mapping; times in ms, areas in mm²."""
        stamps = self.images
        poses = max(len(self.sent.get(topic, [])) for topic in PLAYED)
        seconds = (stamps[-1] - stamps[0]) * 1e-9 if len(stamps) > 1 else 0.0
        latency = {
            topic: dict(zip(("p50", "p99"), self.latency(topic), strict=True))
            for topic in STAMPED[1:]
            if self.sent.get(topic)
        }
        summary: dict[str, Any] = {
            "poses_in": poses,
            "images_out": len(stamps),
            "dropped": max(poses - len(stamps), 0),
            "images_per_second": (len(stamps) - 1) / seconds if seconds else 0.0,
            "latency_ms": latency,
            "nodes": self.reports,
            "recorder": self._recorded(),
        }
        if stamps:
            latency["end_to_end"] = dict(zip(("p50", "p99"), self.end_to_end(), strict=True))
        if areas is not None:
            summary["areas"] = _areas(areas)
        return summary

    def _recorded(self) -> dict[str, dict[str, int]]:
        """Messages that each publisher last reported, beside those recorded, by topic."""
        recorded = {topic.name.lstrip("/"): topic.message_count for topic in self.bag.topics}
        said = {
            topic: count
            for node, report in self.reports.items()
            if node != "session_recorder"
            for topic, count in published_counts(report).items()
        }
        return {
            topic: {"last_reported": count, "recorded": recorded.get(topic, 0)}
            for topic, count in said.items()
        }


def _areas(areas: LumenAreas) -> dict[str, Any]:
    result: dict[str, Any] = {
        "time_s": areas.time.round(4).tolist(),
        "depth_mm": (areas.depth * 1e3).round(4).tolist(),
    }
    for name, area in areas.area.items():
        result[f"{name}_mm2"] = (area * 1e6).round(4).tolist()
        at_rest = (areas.at_rest[name] * 1e6).round(4)
        result[f"{name}_at_rest_mm2"] = [None if np.isnan(x) else float(x) for x in at_rest]
        moments = {"at_full_press": areas.pressed, "after_release": len(areas.time) - 1}
        for moment, sample in moments.items():
            change = areas.change(name, sample)
            result[f"{name}_change_{moment}"] = None if np.isnan(change) else change
    return result


def read_session(file: Path, *further: Path) -> Session:
    """Read a session that `session_recorder` wrote, and those that went on with it.

    Raises:
        BagError: a file cannot be read.
    """
    bag = read_bag(file, *further)
    poses: dict[int, Pose] = {}
    nodes: dict[int, NDArray[np.float64]] = {}
    sent: dict[str, list[tuple[int, int, int]]] = {}
    reports: dict[str, dict[str, str]] = {}
    rest = tetrahedra = None
    there = [topic.name for topic in bag.topics if topic.name in {*STAMPED, *OTHERS}]
    for message in bag.messages(there):
        decoded: Any = bag.deserialize(message)
        if message.topic in STAMPED:
            times = (_stamp(decoded), message.publish_time, message.log_time)
            sent.setdefault(message.topic, []).append(times)
        if message.topic == "/probe/pose":
            poses[_stamp(decoded)] = pose_from(decoded)
        elif message.topic == "/tissue/nodes":
            nodes[_stamp(decoded)] = vectors_from(decoded)
        elif message.topic == "/tissue/rest":
            rest = vectors_from(decoded)
        elif message.topic == "/tissue/tetrahedra":
            tetrahedra = tetrahedra_from(decoded)
        elif message.topic == "/diagnostics":
            for status in decoded.status:
                name = status.name.rsplit("/", 1)[-1]
                reports[name] = {item.key: item.value for item in status.values}
    return Session(bag, poses, nodes, rest, tetrahedra, sent, reports)


def write_summary(summary: dict[str, Any], file: Path) -> None:
    """The summary as indented JSON."""
    file.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _percentiles(ages: list[int]) -> tuple[float, float]:
    p50, p99 = np.percentile([age / MILLISECOND for age in ages], [50, 99])
    return float(p50), float(p99)


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


IMAGES = "/camera/camera_info"  # comes with each image, and has its stamp


@dataclass(frozen=True)
class TrackedPath:
    """Errors of the probe's face on its path."""

    images: int  # of the video
    shown: int  # that the driver published
    mm: NDArray[np.float64]  # (K,) of the images in which the probe was tracked
    degrees: NDArray[np.float64]  # (K,)

    @property
    def summary(self) -> dict[str, Any]:
        """As one JSON-like mapping."""
        summary: dict[str, Any] = {"images": self.images, "shown": self.shown}
        summary["tracked"] = len(self.mm)
        for name, values in (("error_mm", self.mm), ("error_deg", self.degrees)):
            numbers = [round(x, 4) for x in np.percentile(values, [50, 95, 100]).tolist()]
            summary[name] = dict(zip(("median", "p95", "max"), numbers, strict=True))
        return summary

    def __str__(self) -> str:
        found = self.summary
        mm, degrees = found["error_mm"], found["error_deg"]
        return (
            f"tracked in {found['tracked']} of {found['images']} images, from the true path: "
            f"median {mm['median']:.3f} mm and {degrees['median']:.3f}°, "
            f"95 % within {mm['p95']:.3f} mm and {degrees['p95']:.3f}°"
        )


def tracked_path(session: Session, video: PathVideo) -> TrackedPath:
    """Hold ``probe/pose`` against where the probe was in the image of the same stamp.

    Raises:
        BagError: the session has no image of the camera or no pose of the probe.
    """
    stamps = np.array(sorted(stamp for stamp, _, _ in session.sent.get(IMAGES, [])))
    if not len(stamps) or not session.poses:
        raise BagError(f"the session holds no pose of the probe, or nothing on {IMAGES}")
    # The driver begins when all listen, so the last image is recorded for certain; each of the
    # others is so many periods before it as its stamp says.
    before = np.round((stamps[-1] - stamps) * 1e-9 * video.rate).astype(int)
    shown_at = dict(zip(stamps.tolist(), (len(video.poses) - 1 - before).tolist(), strict=True))
    off, turned = [], []
    for stamp, pose in session.poses.items():
        number = shown_at.get(stamp)
        if number is None or number < 0:
            continue
        true = video.poses[number]
        off.append(1e3 * float(np.linalg.norm(pose.position - true.position)))
        turned.append(float(np.degrees(rotation_angle(pose, true))))
    if not off:
        raise BagError(f"no pose of the probe has the stamp of an image on {IMAGES}")
    return TrackedPath(len(video.poses), len(stamps), np.array(off), np.array(turned))
