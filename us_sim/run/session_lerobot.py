"""Recorded sessions as a LeRobot data set: each is an episode, resampled to one rate.

Numbers are interpolated linearly, orientations on the shortest arc at constant angular velocity
(slerp; K. Shoemake, Animating rotation with quaternion curves, 1985), and of images the latest is
shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from us_sim import Progress
from us_sim.errors import BagError, TrackingError
from us_sim.recording.decoding import SECOND
from us_sim.recording.lerobot_writer import (
    IMAGES,
    STATE,
    Frame,
    LeRobotEpisode,
    require_lerobot,
    write_episodes,
)
from us_sim.recording.path import are_poses, find_whole_name
from us_sim.recording.reader import Bag, read_bag
from us_sim.run.session_tables import (
    VALUES,
    list_pose_sources,
    list_topics,
    read_times,
    read_values,
)
from us_sim.settings.spelling import format_count
from us_sim.tracking.camera.encodings import decode_image, decompress_image

PIXELS: Mapping[str, Callable[[Any, str], NDArray[np.uint8]]] = {
    "sensor_msgs/msg/Image": decode_image,
    "sensor_msgs/msg/CompressedImage": decompress_image,
}
"""Decoders of images by their types."""
Times = NDArray[np.int64]
"""ns, strictly increasing."""
_HIGHEST_RATE = 1000  # Hz
_MOST_FRAMES = 10_000_000
"""Of a session; four days at 30 a second. One wrong stamp can make it last for decades."""
_LATE = SECOND  # ns that a stamp may be older than one before; more is another time


def convert_sessions(
    sessions: Sequence[Path],
    folder: Path,
    task: str,
    progress: Progress,
    *,
    rate: int | None = None,
    is_video: bool = False,
    **wanted: Any,
) -> list[str]:
    """Write bags of any kind as episodes, and say of each topic what became of its messages.

    They have ``rate`` frames a second, or the `usual_rate` of the first. What is ``wanted`` of each
    is said as for `Episode`, and all else as for `write_episodes`.

    Raises:
        BagError: a session cannot be read, or has nothing that is wanted, or at no time all of it.
        EpisodeError: as for `write_episodes`.
    """
    require_lerobot()
    if rate is not None and not 1 <= rate <= _HIGHEST_RATE:
        raise BagError(f"--rate: {rate} is outside 1 to {_HIGHEST_RATE} frames a second")
    hertz = rate or Episode(read_bag(sessions[0]), **wanted).usual_rate
    told: list[str] = []
    counts: list[int] = []

    def episodes() -> Iterator[LeRobotEpisode]:
        for session in sessions:
            episode = Episode(read_bag(session), **wanted)
            moments = episode.choose_moments(hertz)
            frames = episode.make_frames(moments, progress)
            yield LeRobotEpisode(frames, episode.names, task, str(session))
            counts.append(len(moments))
            told.extend(f"{session.name}: {sentence}" for sentence in episode.describe_use(moments))

    write_episodes(folder, hertz, episodes(), is_video=is_video)
    progress(1.0, "")
    return [*told, f"{format_count(sum(counts), 'frame')} at {hertz} Hz in {folder}"]


@dataclass
class Track:
    """A topic of images or of numbers, or a body's poses, over time."""

    name: str
    table: pd.DataFrame  # by time, ns: numbers, NaN where a message lacks one; or places of images
    notes: list[str]  # on messages that are not as they should be
    is_image: bool = False
    turns: bool = False  # whether the numbers are poses
    damaged: int = 0  # of the images that were to be shown

    def __post_init__(self) -> None:
        if len(self.table) < 2:
            messages = format_count(len(self.table), "message")
            raise BagError(f"has {messages} of use, and two are needed")
        self.times: Times = self.table.index.to_numpy()

    def interpolate(self, moments: Times) -> NDArray[np.float32]:
        """Interpolate (M, N) numbers, each between the nearest that there are.

        From one moment to the next a quaternion does not change its sign without need; the first
        has w of 0 or more.
        """
        made = np.empty((len(moments), self.table.shape[1]), np.float32)
        wanted = (moments - moments[0]) * 1e-9  # doubles count no ns since 1970
        for k, name in enumerate(self.table):
            known = self.table[name].dropna()
            made[:, k] = np.interp(wanted, (known.index - moments[0]) * 1e-9, known)
        if self.turns:
            turns = Rotation.from_quat(self.table.to_numpy()[:, 3:])
            found = Slerp((self.times - moments[0]) * 1e-9, turns)(wanted).as_quat()
            along = np.einsum("ij,ij->i", found[1:], found[:-1]) < 0
            found[np.cumsum(np.r_[found[0, 3] < 0, along]) % 2 == 1] *= -1
            made[:, 3:] = found
        return made

    def find_latest(self, moments: Times) -> NDArray[np.int64]:
        """Find the row (M,) of the last message at or before each moment."""
        return np.searchsorted(self.times, moments, side="right") - 1

    def read_images(self, bag: Bag, moments: Times) -> Iterator[NDArray[np.uint8]]:
        """Read the latest image of each moment; for one that is damaged the one before."""
        place, pixels = -1, None
        messages = enumerate(bag.read_messages([self.name]))
        for wanted in self.table["place"].to_numpy()[self.find_latest(moments)]:
            if place < wanted:
                place, raw = next(each for each in messages if each[0] == wanted)
                try:
                    pixels = PIXELS[raw.type_name](bag.deserialize(raw), "RGB")
                except TrackingError as error:
                    if pixels is None:
                        raise BagError(f"{bag.path}: {self.name}: {error}") from error
                    self.damaged += 1
            assert pixels is not None
            yield pixels

    def describe_use(self, moments: Times) -> str:
        """Say what became of its messages, in numbers."""
        if self.is_image:
            shown = self.find_latest(moments)
            oldest = (moments - self.times[shown]).max() / SECOND
            images = f"{len(np.unique(shown))} of {format_count(len(self.times), 'image')}"
            told = f"{images} shown, which are {oldest:.3f} s old at most"
        else:
            between = "slerp" if self.turns else "linear"
            messages = format_count(len(self.times), "message")
            gap = np.diff(self.times).max() / SECOND
            told = f"{between} between {messages}, {gap:.3f} s apart at most"
        damaged = [f"{self.damaged} cannot be decoded"] if self.damaged else []
        return "; ".join([f"{self.name}: {told}", *damaged, *self.notes])


class Episode:
    """The wanted parts of a session.

    Args:
        bag: the session.
        topics: or bodies, as ``/tf:probe``; where there are none, all topics of a type that is
            known, and bodies of others only without any PoseStamped.
        action: a topic or body that is the action; it may be named here alone.
        by_log_time: go by when messages were recorded, and not by their stamps.

    Raises:
        BagError: the session has none, or one that was named cannot be used.
    """

    def __init__(
        self,
        bag: Bag,
        topics: Sequence[str] = (),
        action: str | None = None,
        by_log_time: bool = False,
    ) -> None:
        self._bag, self._by_log_time = bag, by_log_time
        self._left_out = [bag.fault] if bag.fault else []
        self._left_out += [
            f"the recorder lost {n} of {name}" for name, n in bag.count_losses().items()
        ]
        self._actions = [find_whole_name(bag, action)] if action else []
        named = [find_whole_name(bag, name) for name in topics] + self._actions
        self._tracks: list[Track] = []
        all_known = [*list_topics(bag, *PIXELS, *VALUES), *list_pose_sources(bag), *self._actions]
        for name in dict.fromkeys(named if topics else all_known):
            try:
                self._tracks.append(self._read_track(name))
            except (BagError, TrackingError) as error:
                if name in named:
                    raise BagError(f"{bag.path}: {name}: {error}") from error
                self._left_out.append(f"{name} is left out: {error}")
        if not self._tracks:
            raise BagError(
                f"{bag.path} has no images, poses, wrenches, twists or joint states that can be "
                f"used; {'; '.join(self._left_out) or 'it has other topics alone'}"
            )
        self._tracks.sort(key=lambda track: not track.is_image)
        self._images = [track for track in self._tracks if track.is_image]
        self._numbers: dict[str, list[Track]] = {STATE: [], "action": []}
        for track in self._tracks[len(self._images) :]:
            self._numbers["action" if track.name in self._actions else STATE].append(track)

    @property
    def usual_rate(self) -> int:
        """Find the frames a second of the images, or else of what is fastest."""
        steps = [np.median(np.diff(each.times)) for each in self._images or self._tracks]
        return int(np.clip(round(SECOND / min(steps)), 1, _HIGHEST_RATE))

    @property
    def names(self) -> dict[str, Sequence[str]]:
        """Name the numbers of each feature."""
        return {
            feature: [f"{each.name.strip('/')}.{part}" for each in tracks for part in each.table]
            for feature, tracks in self._numbers.items()
        }

    def choose_moments(self, rate: int) -> Times:
        """Choose times of frames, ns: from when all topics have begun until one of them ends.

        Raises:
            BagError: they are never there at once, or for absurdly long.
        """
        begins, ends = [], []
        for each in self._tracks:  # as long as all of its numbers are known
            known = [each.table[name].dropna().index for name in each.table]
            begins.append(max(int(times[0]) for times in known))
            ends.append(min(int(times[-1]) for times in known))
        first, begin, end = min(begins), max(begins), min(ends)
        count = (end - begin) * rate // SECOND + 1
        if end <= begin or count > _MOST_FRAMES:
            told = ", ".join(
                f"{track.name} from {(a - first) / SECOND:.3f} to {(b - first) / SECOND:.3f} s"
                for track, a, b in zip(self._tracks, begins, ends, strict=True)
            )
            raise BagError(
                f"{self._bag.path}: by their stamps there is {told}: name those that go together "
                f"with --topics, or give --by-log-time where clocks differ"
            )
        return begin + np.arange(count) * SECOND // rate

    def make_frames(self, moments: Times, progress: Progress = lambda *_: None) -> Iterator[Frame]:
        """Make the features of each moment."""
        rows = {
            feature: np.hstack([each.interpolate(moments) for each in tracks])
            for feature, tracks in self._numbers.items()
            if tracks
        }
        images = {}
        for each in self._images:  # lerobot allows no slash in a feature's name
            name = each.name.strip("/").replace("/", "_")
            images[f"{IMAGES}{name}"] = each.read_images(self._bag, moments)
        for k in range(len(moments)):
            progress(k / len(moments), self._bag.path.name)
            shown = {name: next(pixels) for name, pixels in images.items()}
            yield shown | {name: row[k] for name, row in rows.items()}

    def describe_use(self, moments: Times) -> Iterator[str]:
        """Say what became of its messages, after the frames were taken."""
        yield format_count(len(moments), "frame")
        yield from self._left_out
        yield from (each.describe_use(moments) for each in self._tracks)

    def _read_track(self, name: str) -> Track:
        topic = self._bag.find_topic(name.partition(":")[0])
        if topic.type_name not in PIXELS:
            return self._read_numbers(name, turns=topic.type_name not in VALUES)
        if name in self._actions:
            raise BagError("is a topic of images, which are no action")
        for raw in self._bag.read_messages([name]):  # refused at once where it cannot be decoded
            PIXELS[topic.type_name](self._bag.deserialize(raw), "RGB")
            break
        times, notes = self._judge_times(read_times(self._bag, [name])[name])
        is_shown = times > times.cummax().shift(fill_value=-1)  # else it came too late
        table = pd.DataFrame({"place": times.index[is_shown]}, index=times[is_shown])
        return Track(name, table, notes, is_image=True)

    def _read_numbers(self, name: str, *, turns: bool) -> Track:
        found, table = read_values(self._bag, name)
        frames = found["frame"].unique()
        if turns and len(frames) > 1:
            raise BagError(f"has poses in the frames {', '.join(frames)}, and a path has one")
        times, notes = self._judge_times(found)
        there = pd.DataFrame(np.isfinite(table))
        if turns and len(table):
            there = there.mul(are_poses(table.to_numpy()), axis=0)
        table = table.where(there).set_axis(times)
        # Numbers of the same time go together, each as it came first.
        repeated = (table.notna().groupby(level=0).cumsum() > 1) & table.notna()
        if count := int(repeated.any(axis=1).sum()):
            notes.append(f"{count} have the time of one before and are left out")
        if count := int((~there.any(axis=1)).sum()):
            notes.append(f"{count} are not finite and left out")
        table = table.groupby(level=0).first().dropna(how="all").dropna(axis=1, how="all")
        return Track(name, table, notes, turns=turns)

    def _judge_times(self, table: pd.DataFrame) -> tuple[pd.Series, list[str]]:
        """Give each message its time, ns, and say what is odd; refuse one of another time."""
        stamps = table["logged" if self._by_log_time else "stamp"]
        has_none = stamps == 0
        times = stamps.mask(has_none, table["logged"])
        late = times.cummax() - times
        if late.max() > _LATE:
            raise BagError(
                f"its stamps go back by {late.max() / SECOND:.1f} s, so nobody knows which "
                f"messages go together: give --by-log-time"
            )
        notes = []
        if count := int(has_none.sum()):
            have = format_count(count, "message has", "messages have")
            notes.append(f"{have} no stamp, but the time of recording")
        if count := int((late > 0).sum()):
            are = format_count(count, "message is", "messages are")
            notes.append(f"{are} stamped before one that was recorded earlier")
        return times, notes
