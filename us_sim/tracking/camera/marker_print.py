"""Markers to print at true scale, with a ruler to check the printer by.

>>> from us_sim.tracking.camera.marker_print import sheets
>>> from us_sim.tracking.camera.rigid_body import RigidBody
>>> sheet, = sheets(RigidBody.single("4X4_50", 7, 0.04))
>>> sheet.marked[0].round(1)  # mm from the paper's upper left corner
array([[16.7, 16.7],
       [56.7, 16.7],
       [56.7, 56.7],
       [16.7, 56.7]])
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.tracking.camera.markers import dictionary
from us_sim.tracking.camera.rigid_body import RigidBody, printed_board
from us_sim.tracking.settings import BOARDS, MARKER_SIZE

PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height in mm."""

_MARGIN = 10.0  # mm, that printers leave white
_FOOT = 22.0  # mm, of the ruler and what is written
_GAP = 6.0  # mm, between markers that are cut apart, for their numbers
_FLAT = 1e-5  # m
_DOTS = 300  # per inch, of a picture


@dataclass(frozen=True)
class PrintSettings(Settings):
    """Options of ``us-sim print-marker``: the markers and the paper."""

    error = TrackingError

    id: int = setting(Quantity("number", 0, 65535), "number of the one marker", default=0)
    board: str | None = setting(
        description="a board in place of one marker", choices=BOARDS, default=None
    )
    size: str | None = setting(description="a board's columns and rows: 5x7", default=None)
    marker: float = setting(MARKER_SIZE, "edge of a marker: '40 mm'", default=0.04)
    square: float | None = setting(MARKER_SIZE, "edge of a ChArUco board's square", default=None)
    separation: float | None = setting(MARKER_SIZE, "between the markers of a grid", default=None)
    dictionary: str = setting(description="that the markers are of", default="4X4_50")
    paper: str = setting(description="of the sheets", choices=tuple(PAPERS), default="A4")

    def body(self) -> RigidBody:
        """The marker or the board.

        Raises:
            TrackingError: it is impossible, or the dictionary has too few markers.
        """
        if self.board is None:
            return RigidBody.single(self.dictionary, self.id, self.marker)
        return printed_board(
            self.board,
            self.size,
            self.dictionary,
            marker=self.marker,
            square=self.square,
            separation=self.separation,
        )


@dataclass(frozen=True, eq=False)
class Sheet:
    """The print on one sheet of paper; mm from its upper left corner, x right, y down."""

    body: RigidBody
    paper: str
    ids: tuple[int, ...]
    marked: NDArray[np.float64]  # (n, 4, 2), corners of each marker, as the body orders them
    black: list[NDArray[np.float64]]  # (4, 2) each
    labels: list[tuple[float, float, str]]  # where, and what is written there
    foot: str


def sheets(body: RigidBody, paper: str = "A4") -> list[Sheet]:
    """The sheets that show every marker of a body at true scale.

    A flat body is one piece on one sheet. Markers of another are printed one by one, to be cut
    out with the white margin of one cell and glued where the body's file says.

    Raises:
        TrackingError: the paper is unknown, or too small.
    """
    if paper not in PAPERS:
        raise TrackingError(f"--paper {paper}: there are {', '.join(PAPERS)}")
    flat = _in_plane(body)
    if flat is not None:
        return [_board(body, flat * 1e3, paper)]
    return _cut_outs(body, paper)


def print_markers(body: RigidBody, out: Path, paper: str = "A4") -> list[Sheet]:
    """Write the sheets of a body to a PDF, or to a PNG that says its dots an inch.

    Raises:
        TrackingError: the file exists or is neither, or the paper is too small.
    """
    if out.suffix.lower() not in (".pdf", ".png"):
        raise TrackingError(f"{out}: must be a file that ends in .pdf or .png")
    if out.exists():
        raise TrackingError(f"{out}: exists already; choose another name")
    pages = sheets(body, paper)
    if out.suffix.lower() == ".png" and len(pages) > 1:
        raise TrackingError(f"{out}: the body needs {len(pages)} sheets; write a .pdf")
    content = io.BytesIO()
    if out.suffix.lower() == ".png":
        _figure(pages[0]).savefig(content, format="png", dpi=_DOTS)
    else:
        with PdfPages(content, metadata={"Title": pages[0].foot, "CreationDate": None}) as pdf:
            for page in pages:
                pdf.savefig(_figure(page))
    try:
        with out.open("xb") as file:
            file.write(content.getvalue())
    except FileExistsError:
        raise TrackingError(f"{out}: exists already; choose another name") from None
    return pages


def _in_plane(body: RigidBody) -> NDArray[np.float64] | None:
    """Corners (M, 4, 2) m in the plane of the markers, x right and y down as one sees them; None
    where they are not in one plane.
    """
    normal = body.normals[0]
    offsets = (body.corners - body.corners[0, 0]) @ normal
    if np.abs(offsets).max() > _FLAT or (body.normals @ normal).min() < 0.999:
        return None
    right = body.corners[0, 1] - body.corners[0, 0]
    right /= np.linalg.norm(right)
    down = np.cross(right, normal)
    return np.asarray(body.corners @ np.stack([right, down], axis=1))


def _board(body: RigidBody, corners: NDArray[np.float64], paper: str) -> Sheet:
    cell = _cell(body, corners[0])
    quiet = cell
    black: list[NDArray[np.float64]] = []
    if body.chessboard is not None:
        side = body.chessboard.square * 1e3
        # The markers are in the middles of the white squares, so the others are black.
        board = (body.corners[..., :2] * 1e3).mean(axis=1)
        white = {tuple(place) for place in np.floor(board / side).astype(int).tolist()}
        shift = corners.mean(axis=1)[0] - board[0]
        for row in range(body.chessboard.rows):
            for column in range(body.chessboard.columns):
                if (column, row) not in white:
                    black.append(shift + side * (_UNIT + np.array([column, row])))
        low = shift
        high = shift + side * np.array([body.chessboard.columns, body.chessboard.rows])
        quiet = 0.2 * side
    else:
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    start = np.array([_MARGIN, _MARGIN]) + quiet
    _require_fits(high - low + 2 * quiet, paper)
    move = start - low
    corners = corners + move
    black = [square + move for square in black]
    for number, quadrilateral in zip(body.ids.tolist(), corners, strict=True):
        black += _cells(body.dictionary, number, quadrilateral)
    return Sheet(body, paper, tuple(body.ids.tolist()), corners, black, [], _describe(body))


def _cut_outs(body: RigidBody, paper: str) -> list[Sheet]:
    """Markers one by one, row by row, and sheet by sheet."""
    width, height = PAPERS[paper]
    pages: list[Sheet] = []
    placed: list[tuple[int, NDArray[np.float64]]] = []
    labels: list[tuple[float, float, str]] = []
    x, y, tallest = _MARGIN, _MARGIN, 0.0

    def finish() -> None:
        black = [part for number, at in placed for part in _cells(body.dictionary, number, at)]
        ids = tuple(number for number, _ in placed)
        marked = np.array([at for _, at in placed])
        pages.append(Sheet(body, paper, ids, marked, black, list(labels), _describe(body)))
        placed.clear()
        labels.clear()

    for number, corners in zip(body.ids.tolist(), body.corners, strict=True):
        flat = _in_plane(RigidBody(body.dictionary, np.array([number]), corners[None]))
        assert flat is not None
        shape = flat[0] * 1e3
        quiet = _cell(body, shape)
        size = np.ptp(shape, axis=0) + 2 * quiet
        _require_fits(size, paper)
        if x + size[0] > width - _MARGIN:
            x, y, tallest = _MARGIN, y + tallest + _GAP, 0.0
        if y + size[1] > height - _MARGIN - _FOOT:
            finish()
            x, y, tallest = _MARGIN, _MARGIN, 0.0
        placed.append((number, shape - shape.min(axis=0) + [x + quiet, y + quiet]))
        labels.append((x + quiet, y + size[1] + 0.7 * _GAP, str(number)))
        x += size[0] + _GAP
        tallest = max(tallest, float(size[1]))
    finish()
    return pages


_UNIT = np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1]])


def _cell(body: RigidBody, corners: NDArray[np.float64]) -> float:
    """A marker's cell, in the unit of its corners."""
    edge = float(np.linalg.norm(corners[1] - corners[0]))
    return edge / (dictionary(body.dictionary).markerSize + 2)


def _cells(name: str, number: int, corners: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Runs of black cells, row by row, of a marker with corners (4, 2)."""
    bits = dictionary(name).markerSize + 2
    code = np.asarray(cv2.aruco.generateImageMarker(dictionary(name), number, bits)) == 0
    runs = []
    for row in range(bits):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], code[row].astype(int), [0]])))
        for start, end in edges.reshape(-1, 2) / bits:
            s = np.array([start, end, end, start])[:, None]
            t = np.array([row, row, row + 1, row + 1])[:, None] / bits
            upper = corners[0] + s * (corners[1] - corners[0])
            lower = corners[3] + s * (corners[2] - corners[3])
            runs.append(upper + t * (lower - upper))
    return runs


def _describe(body: RigidBody) -> str:
    edge = 1e3 * float(np.linalg.norm(body.corners[0, 1] - body.corners[0, 0]))
    numbers = ", ".join(str(number) for number in body.ids[:6].tolist())
    more = ", …" if len(body.ids) > 6 else ""
    board = body.chessboard
    if board is not None:
        return (
            f"ChArUco {board.columns}x{board.rows}, squares {board.square * 1e3:g} mm, markers "
            f"{board.size * 1e3:g} mm, {body.dictionary}"
        )
    return f"{body.dictionary}, {numbers}{more}: {edge:.4g} mm"


def _require_fits(size: NDArray[np.float64], paper: str) -> None:
    width, height = PAPERS[paper]
    room = width - 2 * _MARGIN, height - 2 * _MARGIN - _FOOT
    if size[0] > room[0] or size[1] > room[1]:
        raise TrackingError(
            f"what is to be printed is {size[0]:.0f} × {size[1]:.0f} mm with its white margin; "
            f"{paper} has room for {room[0]:.0f} × {room[1]:.0f}: take a larger --paper or "
            f"smaller markers"
        )


def _figure(sheet: Sheet) -> Figure:
    """The sheet as matplotlib draws it, in its true size."""
    width, height = PAPERS[sheet.paper]
    figure = Figure(figsize=(width / 25.4, height / 25.4))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    # One outline of all, so that no viewer shows seams between neighbours.
    points = np.concatenate([[*part, part[0]] for part in sheet.black])
    codes = [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY] * len(sheet.black)
    axes.add_patch(
        PathPatch(Outline(points, codes), facecolor="black", edgecolor="none", snap=False)
    )
    for x, y, text in sheet.labels:
        axes.text(x, y, text, fontsize=8, va="baseline")
    base = height - _MARGIN
    axes.text(_MARGIN, base - 13, sheet.foot, fontsize=9, va="baseline")
    told = "print at 100 %, unscaled: this line is 100 mm long. Leave white around the markers"
    axes.text(_MARGIN, base - 8.5, told, fontsize=8, va="baseline")
    axes.plot([_MARGIN, _MARGIN + 100], [base, base], color="black", linewidth=0.5)
    for tick in range(11):
        x = _MARGIN + 10 * tick
        axes.plot([x, x], [base - (4 if tick % 5 == 0 else 2.5), base], "k-", linewidth=0.5)
    return figure
