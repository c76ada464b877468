"""Images from a camera, a stream or a video file, as OpenCV opens them.

>>> from us_sim.tracking.camera.video_source import VideoSource
>>> VideoSource("0").is_file, VideoSource("rtsp://camera.local/stream").is_file
(False, False)
>>> VideoSource("film.avi")
Traceback (most recent call last):
us_sim.errors.TrackingError: film.avi: there is no such file; give a video, a camera's number or ...
"""

from __future__ import annotations

import os
import stat
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError

_PATIENCE_MS = 5000  # with a stream that is not there or sends nothing
_USUAL_RATE = 30.0  # Hz, of a file that does not say
_ERRORS_ONLY = 2  # of OpenCV's levels
_OLDEST_S = 1.0  # a camera's own time stamp is believed up to this age


class VideoSource:
    """A source of images, one after the other, that can be opened and closed any number of times.

    Args:
        source: a camera's number ("0"), its device ("/dev/video0"), the address of a stream, or
            a video file.
        size: width and height in pixels that a camera is asked for.
        rate: images a second that a camera is asked for, or at which a file is played; 0 leaves
            it to them.

    Raises:
        TrackingError: the file is not there, or it is a folder or a pipe.
    """

    def __init__(self, source: str, *, size: tuple[int, int] | None = None, rate: float = 0.0):
        self.name = source.strip()
        self._size, self._rate = size, rate
        self._capture: cv2.VideoCapture | None = None
        path = Path(os.path.expanduser(self.name))
        is_live = self.name.isdigit() or "://" in self.name
        if not is_live and not os.path.exists(path):
            if self.name.startswith("/dev/"):
                is_live = True  # it may be plugged in later
            else:
                raise TrackingError(
                    f"{source}: there is no such file; give a video, a camera's number or a "
                    f"stream's address"
                )
        mode = 0 if is_live else os.stat(path).st_mode
        if not (is_live or stat.S_ISREG(mode) or stat.S_ISCHR(mode)):
            raise TrackingError(
                f"{source}: it is neither a file nor a device; give a video, a camera's number or "
                f"a stream's address"
            )
        self.is_file = stat.S_ISREG(mode)
        self._target = str(path) if not is_live else self.name

    def open(self) -> bool:
        """Begin, or begin again, with the first image; whether there is something to begin with."""
        self.close()
        _hush()
        if self.name.isdigit():
            capture = cv2.VideoCapture(int(self.name))
        elif "://" in self.name:
            patience = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC]
            settings = [number for key in patience for number in (key, _PATIENCE_MS)]
            capture = cv2.VideoCapture(self.name, cv2.CAP_FFMPEG, settings)
        else:
            capture = cv2.VideoCapture(self._target)
        if not capture.isOpened():
            return False
        if not self.is_file:
            if self._size is not None:
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
            if self._rate:
                capture.set(cv2.CAP_PROP_FPS, self._rate)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._capture = capture
        return True

    def close(self) -> None:
        """Let go of the camera or file."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    @property
    def interval(self) -> float:
        """s between two images of a file."""
        rate = self._rate
        if not rate and self._capture is not None:
            rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return 1.0 / (rate if 0.01 < rate < 1e4 else _USUAL_RATE)

    def grab(self) -> float | None:
        """Wait for the next image; its age in s, or None where there is none any more.

        The age is 0 but for cameras under Linux, whose driver stamps what it reads.
        """
        if self._capture is None or not self._capture.grab():
            return None
        if self.is_file or self._capture.getBackendName() != "V4L2":
            return 0.0
        age = time.monotonic() - 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        return age if 0.0 < age < _OLDEST_S else 0.0

    def pixels(self, *, grey: bool) -> NDArray[np.uint8] | None:
        """The image that was grabbed, (rows, columns) or (rows, columns, 3) blue, green, red."""
        if self._capture is None:
            return None
        ok, image = self._capture.retrieve()
        if not ok or image is None or image.dtype != np.uint8:
            return None
        if image.ndim == 3 and image.shape[2] == 1:
            image = image[:, :, 0]
        if grey and image.ndim == 3:
            image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        elif not grey and image.ndim == 2:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        return np.asarray(image, dtype=np.uint8)


def _hush() -> None:
    """Silence OpenCV and FFmpeg, as the caller says in a sentence when nothing is there."""
    # OpenCV 5 has moved it.
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    set_level(_ERRORS_ONLY)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
