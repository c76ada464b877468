"""Poses, wrenches, images and areas of a recording as files that other programs read."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from us_sim.errors import BagError, TrackingError
from us_sim.recording.path import POSE_STAMPED, Row, bodies_in, is_pose, pose_rows
from us_sim.recording.reader import Bag
from us_sim.recording.stamps import stamp_reader
from us_sim.recording.topic import BagTopic
from us_sim.recording.wrench import WRENCH_STAMPED, read_wrenches
from us_sim.run.resimulation import scene_of
from us_sim.run.session_summary import read_session
from us_sim.settings.spelling import counted
from us_sim.tracking.camera.encodings import decode_image, decompress_image

AREAS = 200  # images of which areas are measured, evenly over the session
_DECODE: Mapping[str, Callable[[Any, str], NDArray[np.uint8]]] = {
    "sensor_msgs/msg/Image": decode_image,
    "sensor_msgs/msg/CompressedImage": decompress_image,
}
_LONGEST_PAUSE = 1.0  # s, that a video stands still
_RATES = (1.0, 240.0)  # images a second of a video
_MILLIMETRE = 1e-3
Progress = Callable[[float, str], None]


def write_poses(bag: Bag, folder: Path) -> Iterator[Path | str]:
    """Every PoseStamped topic, or else every body of others, as CSV and in TUM's format.

    TUM's (``timestamp tx ty tz qx qy qz qw``, s and m) has no poses that are not finite or have no
    orientation; the CSV has all, with the time at which they were recorded, and their frame. What
    TUM's has not, and stamps that go back, are said in sentences among the files.

    Raises:
        BagError: a file exists, or cannot be written.
    """
    for name in _bodies(bag):
        rows = pd.DataFrame(list(pose_rows(bag, name)), columns=list(Row._fields))
        poses = pd.DataFrame(rows.pop("pose").tolist(), columns=_POSE, dtype=float)
        stamps, logged = rows["stamp"].map(_s), rows["log_time"].map(_s)
        head = {"stamp_s": stamps, "recorded_s": logged, "frame": rows["frame_id"]}
        yield _write_csv(
            folder / f"{_file_name(name)}.csv", pd.DataFrame(head).join(poses), na_rep="nan"
        )
        usable = is_pose(poses.to_numpy())
        kept = poses[usable].map(repr)
        kept.insert(0, "stamp", stamps[usable])
        file = folder / f"{_file_name(name)}.tum"
        yield _write_csv(file, kept, sep=" ", header=False)
        if rejected := int((~usable).sum()):
            are = counted(rejected, "pose is", "poses are")
            yield f"{name}: {are} not finite or without an orientation, and not in {file.name}"
        yield from _times_told(name, rows["stamp"][usable].tolist(), file.name)


_POSE = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]


def _bodies(bag: Bag) -> list[str]:
    stamped = [topic.name for topic in bag.topics if topic.type_name == POSE_STAMPED]
    return stamped or [name for names in bodies_in(bag).values() for name in names]


def require_parts(bag: Bag, options: Collection[str]) -> None:
    """Refuse at once all options whose parts a bag lacks.

    Raises:
        BagError: it lacks some.
    """
    types = {topic.type_name for topic in bag.topics if topic.message_count}
    is_there = {
        "poses": bool(_bodies(bag)),
        "wrench": WRENCH_STAMPED in types,
        "images": not types.isdisjoint(_DECODE),
        "video": not types.isdisjoint(_DECODE),
        "areas": "scene.yaml" in bag.attachments([]),
    }
    names = {"wrench": "wrench", "images": "image", "video": "image", "areas": "scene attached"}
    if lacking := [option for option in options if not is_there[option]]:
        parts = " and ".join(dict.fromkeys(f"no {names.get(o, o)}" for o in lacking))
        leave = " and ".join(f"--{option}" for option in lacking)
        raise BagError(f"{bag.path} holds {parts}; leave out {leave}")


def _times_told(name: str, stamps: list[int], where: str, remedy: str = "") -> Iterator[str]:
    """Sentences on stamps that are 0 or go back."""
    if missing := stamps.count(0):
        yield f"{name}: {missing} of {counted(len(stamps), 'stamp')} are 0{remedy}"
    back = [k for k in range(1, len(stamps)) if stamps[k] < stamps[k - 1]]
    if back:
        k = back[0]
        yield (
            f"{name}: stamps go back {counted(len(back), 'time')}, first by "
            f"{(stamps[k - 1] - stamps[k]) / 1e9:.3f} s at line {k + 1} of {where}"
        )


def write_wrenches(bag: Bag, folder: Path) -> Iterator[Path]:
    """Every WrenchStamped topic as CSV, N and N m.

    Raises:
        BagError: there is no wrench on a topic, a file exists, or cannot be written.
    """
    for name in [topic.name for topic in bag.topics if topic.type_name == WRENCH_STAMPED]:
        record = read_wrenches(bag.path, name)
        table = pd.DataFrame(record.wrenches, columns=_WRENCH)
        table.insert(0, "stamp_s", pd.Series(record.stamps).map(_s))
        table.insert(1, "frame", record.frame_id)
        yield _write_csv(folder / f"{_file_name(name)}.csv", table)


_WRENCH = ["fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm"]


def write_images(
    bag: Bag, folder: Path, progress: Progress, *, pictures: bool, video: bool
) -> Iterator[Path | str]:
    """Every topic of images as PNG files, as MP4, or both; and a CSV with stamp and scale of each.

    PNG files hold their scale as resolution, and it, stamp, topic and frame as texts. A video has a
    constant rate, the usual one of the images: they are shown when they were stamped, but none for
    longer than a second. Images without a stamp have the time of their recording. What cannot be
    decoded is said in sentences among the files.

    Args:
        bag: with images, raw or compressed, as `tracking.camera.encodings` knows them.
        folder: gets a folder for each topic, and a video.
        progress: takes the fraction done, and the topic.
        pictures: write PNG files.
        video: write an MP4.

    Raises:
        BagError: there is no image that can be decoded, a file exists, or cannot be written.
    """
    is_written = False
    for topic in bag.topics:
        if topic.type_name not in _DECODE or not topic.message_count:
            continue
        for made in _write_topic(bag, topic, folder, progress, pictures, video):
            is_written = is_written or isinstance(made, Path)
            yield made
    progress(1.0, "")
    if not is_written:
        raise BagError(f"{bag.path} holds no image that can be decoded")


def _write_topic(
    bag: Bag, topic: BagTopic, folder: Path, progress: Progress, pictures: bool, video: bool
) -> Iterator[Path | str]:
    stem = folder / _file_name(topic.name)
    scale = _scale(bag, topic)
    stamps, times = _stamps(bag, topic)
    beats, rate = _beats(times)
    spacing = [f"{each / _MILLIMETRE:.6g}" for each in scale or ()]
    facts = [f"topic {topic.name}"]
    if scale:
        facts.append("pixel spacing {} mm across, {} mm down".format(*spacing))
    film = _Film(stem.with_suffix(".mp4"), rate) if video else None
    rows: list[Sequence[object]] = []
    odd: list[str] = []
    for number, message in enumerate(bag.messages([topic.name])):
        progress(min(number / topic.message_count, 0.999), topic.name)
        try:
            decoded: Any = bag.deserialize(message)
            pixels = _DECODE[topic.type_name](decoded, "RGB")
        except (BagError, TrackingError) as error:
            odd.append(str(error))
            continue
        name = f"{number:06d}.png"
        rows.append((name if pictures else number, _s(times[number]), *(spacing or ("", ""))))
        if pictures:
            told = [f"stamp {_s(times[number])} s", f"frame {decoded.header.frame_id}", *facts]
            _write_png(stem / name, pixels, scale, told)
        if film is not None:
            film.show(pixels, beats[number])
    if odd:
        yield f"{topic.name}: {counted(len(odd), 'image')} skipped: {odd[0]}"
    if not rows:
        return
    head = ["image", "stamp_s", "column_spacing_mm", "row_spacing_mm"]
    yield _write_csv(stem.with_suffix(".csv"), pd.DataFrame(rows, columns=head))
    remedy = ": the times are those of the recording"
    yield from _times_told(topic.name, stamps, stem.with_suffix(".csv").name, remedy)
    if pictures:
        yield stem
    if film is not None:
        yield film.finish()


def write_areas(bag: Bag, folder: Path, progress: Progress) -> Iterator[Path]:
    """Areas of vessels in the image plane, now and in the same plane of the tissue at rest.

    Raises:
        BagError: the session has no scene, no vessels, or other files than then; or a file exists.
        UsSimError: the scene cannot be read.
    """
    with scene_of(bag) as scene:
        session = read_session(bag.path)
        areas = session.lumen_areas(scene, AREAS, lambda done: progress(done, "areas"))
    if areas is None:
        raise BagError(f"{bag.path}: no image of it cuts a vessel that can be measured")
    first = min(session.poses)
    stamps = [_s(first + round(1e9 * time)) for time in areas.time]
    table = pd.DataFrame({"stamp_s": stamps, "depth_mm": (1e3 * areas.depth).round(6)})
    for name in areas.area:
        table[f"{name}_mm2"] = (1e6 * areas.area[name]).round(6)
        table[f"{name}_at_rest_mm2"] = (1e6 * areas.at_rest[name]).round(6)
    yield _write_csv(folder / "areas.csv", table)


def _file_name(topic: str) -> str:
    kept = "".join(c if c.isalnum() or c in "._-" else "_" for c in topic.strip("/"))
    return kept or "topic"


def _s(nanoseconds: int) -> str:
    """Seconds with all nine digits, which a float has not since 1970."""
    sign = "-" if nanoseconds < 0 else ""
    return f"{sign}{abs(nanoseconds) // 10**9}.{abs(nanoseconds) % 10**9:09d}"


def _write_csv(file: Path, table: pd.DataFrame, **options: Any) -> Path:
    with _new(file, encoding="utf-8", newline="") as stream:
        table.to_csv(stream, index=False, lineterminator="\n", **options)
    return file


def _new(file: Path, **options: Any) -> Any:
    """A file that was not there, opened for writing."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        return file.open("x" if options else "xb", **options)
    except FileExistsError:
        raise BagError(f"{file} exists already: choose another folder with --out") from None
    except OSError as error:
        raise BagError(f"{file} cannot be written: {error.strerror}") from None


def _scale(bag: Bag, topic: BagTopic) -> tuple[float, float] | None:
    """m from column to column and from row to row, where the recording says so."""
    name = f"{topic.name.rpartition('/')[0]}/image_to_probe"
    if not any(each.name == name for each in bag.topics):
        return None
    for message in bag.messages([name]):
        values = np.array(bag.deserialize(message).data, float)
        if values.shape == (16,) and np.isfinite(values).all():
            across, down = np.linalg.norm(values.reshape(4, 4)[:3, :2], axis=0)
            return (float(across), float(down)) if across > 0 and down > 0 else None
    return None


def _stamps(bag: Bag, topic: BagTopic) -> tuple[list[int], list[int]]:
    """ns of each message: its stamp; and likewise, or where it is 0, when it was recorded."""
    read = stamp_reader(bag, topic)
    if read is None:
        raise BagError(f"{bag.path} defines {topic.type_name} as ROS 2 does not: it has no header")
    try:
        both = [(read(m.data) or 0, m.log_time) for m in bag.messages([topic.name])]
    except (struct.error, IndexError):
        raise BagError(f"{bag.path} holds a message on {topic.name} that is no image") from None
    return [stamp for stamp, _ in both], [stamp or log_time for stamp, log_time in both]


def _beats(stamps: list[int]) -> tuple[list[int], float]:
    """Images of a constant rate that each is shown for, and that rate."""
    steps = np.diff(np.array(stamps, np.float64)) * 1e-9
    usual = float(np.median(steps)) if len(steps) else 0.0
    rate = float(np.clip(1.0 / usual, *_RATES)) if usual > 0 else 25.0
    steps[steps < 0] = 1.0 / rate  # after a clock was set back
    ends = np.cumsum(np.clip(steps, 0.0, _LONGEST_PAUSE)) * rate
    shown = np.diff(np.round(ends), prepend=0.0).astype(int)
    return [*shown.tolist(), 1], rate


def _write_png(
    file: Path, pixels: NDArray[np.uint8], scale: tuple[float, float] | None, facts: list[str]
) -> None:
    texts = PngInfo()
    texts.add_itxt("Description", "; ".join(facts))
    texts.add_itxt("Software", "us_sim")
    dpi = {"dpi": tuple(0.0254 / each for each in scale)} if scale is not None else {}
    with _new(file) as stream:
        Image.fromarray(pixels).save(stream, "PNG", pnginfo=texts, compress_level=3, **dpi)


class _Film:
    """An MP4 in the making; its size is that of the first image."""

    def __init__(self, file: Path, rate: float) -> None:
        self._file, self._rate = file, rate
        self._size = (0, 0)
        self._writer: cv2.VideoWriter | None = None

    def show(self, pixels: NDArray[np.uint8], times: int) -> None:
        """Add an image so many times; one of another size is cut, or gets a black border."""
        if self._writer is None:
            _new(self._file).close()
            rows, columns = pixels.shape[:2]
            self._size = (columns + columns % 2, rows + rows % 2)  # as the format wants it
            codec = cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = cv2.VideoWriter(str(self._file), codec, self._rate, self._size)
            if not self._writer.isOpened():
                self._file.unlink(missing_ok=True)
                raise BagError(
                    f"this OpenCV cannot write {self._file}: install opencv-python-headless with "
                    f"pip, which has FFmpeg, or leave out --video"
                )
        width, height = self._size
        whole = np.zeros((height, width, 3), np.uint8)
        part = pixels[:height, :width]
        whole[: part.shape[0], : part.shape[1]] = (
            part[..., None] if part.ndim == 2 else (part[..., ::-1])
        )
        for _ in range(times):
            self._writer.write(whole)

    def finish(self) -> Path:
        """Close the file."""
        if self._writer is not None:
            self._writer.release()
        return self._file
