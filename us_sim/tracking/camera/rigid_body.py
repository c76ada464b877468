"""Rigid bodies of markers, and the YAML files that define them.

>>> from us_sim.tracking.camera.rigid_body import RigidBody
>>> board = RigidBody.create_grid("6X6_1000", columns=4, rows=5, size=0.0375, separation=0.005)
>>> board.ids[-1], (board.corners[-1, 2] * 1e3).round(1)
(np.int64(19), array([165. , 207.5,   0. ]))
>>> RigidBody.create_single("4X4_50", 50, 0.04)
Traceback (most recent call last):
...
us_sim.errors.TrackingError: marker 50: dictionary 4X4_50 has only markers 0 to 49
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Placement
from us_sim.settings.choice import Choice, ChosenOption
from us_sim.settings.quantity import Quantity
from us_sim.settings.reading import SettingsReader
from us_sim.settings.setting import Settings, setting
from us_sim.settings.text_files import read_yaml
from us_sim.tracking.camera.markers import (
    compute_square_corners,
    count_markers,
    load_dictionary,
    normalise_name,
)
from us_sim.tracking.settings import MARKER_SIZE


@dataclass(frozen=True, eq=False)
class Print:
    """A printed rectangle of equal cells, in the frame of its body."""

    origin: NDArray[np.float64]  # (3,) m, its upper left corner
    along: NDArray[np.float64]  # (3,) m, its upper edge
    down: NDArray[np.float64]  # (3,) m, its left edge
    cells: NDArray[np.bool_]  # (rows, columns), True is white

    @property
    def corners(self) -> NDArray[np.float64]:
        """(4, 3) m."""
        a, b, c = self.origin, self.along, self.down
        return np.array([a, a + b, a + b + c, a + c])


@dataclass(frozen=True)
class Chessboard:
    """The squares of a ChArUco board: a chessboard with a marker in every white square."""

    columns: int  # squares
    rows: int  # squares
    square: float  # m, edge of a square
    size: float  # m, edge of a marker
    dictionary: str
    legacy: bool = False  # white upper left square where the rows are even, as before OpenCV 4.6

    def __post_init__(self) -> None:
        if not self.size < self.square:
            raise TrackingError(
                f"a ChArUco board's markers ({self.size:g} m) must be smaller than its squares "
                f"({self.square:g} m)"
            )
        object.__setattr__(self, "dictionary", normalise_name(self.dictionary))
        _require_in_dictionary(self.dictionary, self.columns * self.rows // 2 - 1)

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's own object for the board."""
        size = (self.columns, self.rows)
        board = cv2.aruco.CharucoBoard(
            size, float(self.square), float(self.size), load_dictionary(self.dictionary)
        )
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """(K, 3) m: the places in which four squares meet, row by row."""
        return np.asarray(self.board.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

    def compute_squares(self, centres: NDArray[np.float64]) -> Print:
        """Return the squares without markers, white where the middles (M, 3) m of those are."""
        white = np.zeros((self.rows, self.columns), dtype=np.bool_)
        column, row = np.floor(centres[:, :2] / self.square).astype(int).T
        white[row, column] = True
        along = np.array([self.columns * self.square, 0.0, 0.0])
        down = np.array([0.0, self.rows * self.square, 0.0])
        return Print(np.zeros(3), along, down, white)


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Markers of one dictionary that move together.

    The corners of a marker are those of its black square, in its own order: the upper left one
    as it is printed, and on clockwise as one sees it.

    Raises:
        TrackingError: a marker twice, or one that the dictionary lacks.
    """

    dictionary: str
    ids: NDArray[np.int64]  # (M,)
    corners: NDArray[np.float64]  # (M, 4, 3) m, in the body's own frame
    chessboard: Chessboard | None = None

    def __post_init__(self) -> None:
        ids = np.array(self.ids, dtype=np.int64)
        corners = np.array(self.corners, dtype=np.float64)
        object.__setattr__(self, "dictionary", normalise_name(self.dictionary))
        for number in ids.tolist():
            _require_in_dictionary(self.dictionary, number)
        numbers, counts = np.unique(ids, return_counts=True)
        if counts.max() > 1:
            raise TrackingError(f"marker {numbers[counts.argmax()]} is in the body twice")
        for array in (ids, corners):
            array.flags.writeable = False
        object.__setattr__(self, "ids", ids)
        object.__setattr__(self, "corners", corners)

    @classmethod
    def create_single(cls, dictionary: str, number: int, size: float) -> RigidBody:
        """Make a body of one marker about its middle, x to its right, y up and z out of the paper.

        Raises:
            TrackingError: there is no such marker.
        """
        return cls(dictionary, np.array([number]), compute_square_corners(size)[None])

    @classmethod
    def create_grid(
        cls,
        dictionary: str,
        columns: int,
        rows: int,
        size: float,
        separation: float,
        first: int = 0,
    ) -> RigidBody:
        """Make a board of markers, numbered row by row from ``first``.

        The origin is the upper left corner of the board, x to the right, y down and z into the
        paper, as OpenCV has it.

        Raises:
            TrackingError: the dictionary is too small.
        """
        marker = size * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        row, column = np.divmod(np.arange(columns * rows), columns)
        places = np.stack([column, row, 0 * row], axis=1) * (size + separation)
        return cls(dictionary, first + np.arange(columns * rows), places[:, None] + marker)

    @classmethod
    def create_charuco(
        cls,
        dictionary: str,
        columns: int,
        rows: int,
        square: float,
        size: float,
        legacy: bool = False,
    ) -> RigidBody:
        """Make a ChArUco board of so many squares; its frame is as that of `create_grid`.

        Raises:
            TrackingError: the markers are larger than squares, or the dictionary is too small.
        """
        chessboard = Chessboard(columns, rows, square, size, dictionary, legacy)
        markers = np.asarray(chessboard.board.getObjPoints(), dtype=np.float64).reshape(-1, 4, 3)
        ids = np.asarray(chessboard.board.getIds()).ravel()
        return cls(dictionary, ids, markers, chessboard)

    @cached_property
    def rows(self) -> dict[int, int]:
        """Index in `ids` of each marker's number."""
        return {int(number): row for row, number in enumerate(self.ids)}

    @cached_property
    def prints(self) -> list[Print]:
        """The prints of it on white, each over those before."""
        printed = [] if self.chessboard is None else [self.chessboard.compute_squares(self.centres)]
        marker = load_dictionary(self.dictionary)
        cells = marker.markerSize + 2
        for number, corners in zip(self.ids.tolist(), self.corners, strict=True):
            code = cv2.aruco.generateImageMarker(marker, number, cells) > 0
            along, down = corners[1] - corners[0], corners[3] - corners[0]
            printed.append(Print(corners[0], along, down, code))
        return printed

    @cached_property
    def centres(self) -> NDArray[np.float64]:
        """(M, 3) m: the middle of each marker."""
        return self.corners.mean(axis=1)

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """(M, 3): unit normal of each marker, towards who sees its front."""
        a, b, c, d = self.corners.transpose(1, 0, 2)
        normals = np.cross(b - d, a - c)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _require_in_dictionary(name: str, number: int) -> None:
    count = count_markers(name)
    if not 0 <= number < count:
        raise TrackingError(f"marker {number}: dictionary {name} has only markers 0 to {count - 1}")


_NUMBER = Quantity("number", 0, 65535)
_COUNT, _SQUARES = Quantity("number", 1, 100), Quantity("number", 2, 100)


@dataclass(frozen=True, kw_only=True)
class _Marker(Placement):
    """A marker of a body: its size, and the place of its middle in the body."""

    error = TrackingError

    id: int = setting(_NUMBER, "number in the dictionary")
    size: float = setting(MARKER_SIZE, "edge of its black square")


@dataclass(frozen=True)
class GridBoard(Settings):
    """A flat grid of markers."""

    error = TrackingError

    columns: int = setting(_COUNT, "markers across")
    rows: int = setting(_COUNT, "markers down")
    size: float = setting(MARKER_SIZE, "edge of a marker")
    separation: float = setting(MARKER_SIZE, "between markers")
    first: int = setting(_NUMBER, "number of the first marker", default=0)

    def create_body(self, dictionary: str) -> RigidBody:
        """Make the board with markers of a dictionary."""
        return RigidBody.create_grid(dictionary, **asdict(self))


@dataclass(frozen=True)
class CharucoBoard(Settings):
    """A chessboard with markers in its white squares."""

    error = TrackingError

    columns: int = setting(_SQUARES, "squares across")
    rows: int = setting(_SQUARES, "squares down")
    square: float = setting(MARKER_SIZE, "side of a square")
    size: float = setting(MARKER_SIZE, "edge of a marker")
    legacy: bool = setting(description="as OpenCV before 4.6 drew it", default=False)

    def create_body(self, dictionary: str) -> RigidBody:
        """Make the board with markers of a dictionary."""
        return RigidBody.create_charuco(dictionary, **asdict(self))


_BOARDS = Choice(
    "board",
    key="kind",
    needs=True,
    error=TrackingError,
    grid=f"{__name__}:GridBoard",
    charuco=f"{__name__}:CharucoBoard",
)


@dataclass(frozen=True)
class _Body(Settings):
    """The file of a body."""

    error = TrackingError

    dictionary: str = setting(description="of the markers")
    markers: tuple[_Marker, ...] = setting(description="one by one", default=())
    board: ChosenOption | None = setting(
        description="in place of markers", choice=_BOARDS, default=None
    )

    def check(self) -> None:
        """Refuse a file with markers and a board, or neither."""
        if bool(self.markers) == (self.board is not None):
            raise self.make_error("markers", "give a list of markers, or a board in place of it")


def read_rigid_body(path: Path | str) -> RigidBody:
    """Read the body that a YAML file describes.

    It has ``dictionary`` and either ``markers`` (each with ``id``, ``size`` and the marker's
    ``position`` and ``orientation`` in the body), or ``board`` (``kind: grid`` with ``columns``,
    ``rows``, ``size``, ``separation`` and ``first``, or ``kind: charuco`` with ``columns``,
    ``rows``, ``square``, ``size`` and ``legacy``).

    Raises:
        TrackingError: the file, or the body in it, cannot be used.
    """
    content = read_yaml(Path(path), TrackingError)
    if not isinstance(content, Mapping):
        raise TrackingError(f"{path}: it must be a mapping with dictionary and markers or board")
    written = SettingsReader(str(path), error=TrackingError).read(_Body, content)
    try:
        if written.board is not None:
            board: GridBoard | CharucoBoard = written.board.resolve_settings(_BOARDS)
            return board.create_body(written.dictionary)
        corners = np.array(
            [
                each.pose.transform_points(compute_square_corners(each.size))
                for each in written.markers
            ]
        )
        numbers = np.array([marker.id for marker in written.markers])
        return RigidBody(written.dictionary, numbers, corners)
    except TrackingError as error:
        raise TrackingError(f"{path}: {error}") from error
