"""Markers to print at true scale, with a ruler to check the printer by.

>>> from us_sim.tracking.camera.marker_print import lay_out_sheets
>>> from us_sim.tracking.camera.rigid_body import RigidBody
>>> sheet, = lay_out_sheets(RigidBody.create_single("4X4_50", 7, 0.04))
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

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.tracking.camera.rigid_body import RigidBody

PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height in mm."""

_MARGIN = 10.0  # mm, that printers leave white
_FOOT = 22.0  # mm, of the ruler and what is written
_GAP = 6.0  # mm, between markers that are cut apart, for their numbers
_FLAT = 1e-5  # m
_DOTS = 300  # per inch, of a picture


@dataclass(frozen=True, eq=False)
class Sheet:
    """The print on one sheet of paper; mm from its upper left corner, x right, y down."""

    paper: str
    marked: NDArray[np.float64]  # (n, 4, 2), corners of each marker, as the body orders them
    black: NDArray[np.float64]  # (b, 4, 2), cells
    labels: list[tuple[float, float, str]]  # where, and what is written there
    foot: str


def lay_out_sheets(body: RigidBody, paper: str = "A4") -> list[Sheet]:
    """Lay out the sheets that show every marker of a body at true scale.

    A flat body is one piece on one sheet. Markers of another are printed one by one, to be cut
    out with the white margin of one cell and glued where the body's file says.

    Raises:
        TrackingError: the paper is unknown, or too small.
    """
    if paper not in PAPERS:
        raise TrackingError(f"--paper {paper}: there are {', '.join(PAPERS)}")
    parts = [body]
    if not _is_flat(body):
        parts = [
            RigidBody(body.dictionary, body.ids[k : k + 1], body.corners[k : k + 1])
            for k in range(len(body.ids))
        ]
    pieces = [_piece(part) for part in parts]
    pitch = np.max([size for *_, size in pieces], axis=0) + _GAP
    room = np.array(PAPERS[paper]) - [2 * _MARGIN, 2 * _MARGIN + _FOOT]
    across, down = ((room + _GAP) // pitch).astype(int).tolist()
    if not across * down:
        wide, high = pitch - _GAP
        raise TrackingError(
            f"what is to be printed is {wide:.0f} × {high:.0f} mm with its white margin; "
            f"{paper} has room for {room[0]:.0f} × {room[1]:.0f}: take a larger --paper or "
            f"smaller markers"
        )
    pages = []
    for first in range(0, len(pieces), across * down):
        marked, black, labels = [], [], []
        for k, (corners, dark, size) in enumerate(pieces[first : first + across * down]):
            place = _MARGIN + pitch * [k % across, k // across]
            marked.append(corners + place)
            black.append(dark + place)
            if len(pieces) > 1:
                x, y = place.tolist()
                labels.append((x, y + float(size[1]) + 0.7 * _GAP, str(body.ids[first + k])))
        whole = np.concatenate(marked), np.concatenate(black)
        pages.append(Sheet(paper, *whole, labels, _describe(body)))
    return pages


def print_markers(body: RigidBody, out: Path, paper: str = "A4") -> list[Sheet]:
    """Write the sheets of a body to a PDF, or to a PNG that says its dots an inch.

    Raises:
        TrackingError: the file exists or is neither, or the paper is too small.
    """
    kind = out.suffix.lower()
    if kind not in (".pdf", ".png"):
        raise TrackingError(f"{out}: must be a file that ends in .pdf or .png")
    pages = lay_out_sheets(body, paper)
    if kind == ".png" and len(pages) > 1:
        raise TrackingError(f"{out}: the body needs {len(pages)} sheets; write a .pdf")
    content = io.BytesIO()
    if kind == ".png":
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


def _is_flat(body: RigidBody) -> bool:
    """Return whether all markers are in one plane and face the same way."""
    offsets = (body.corners - body.corners[0, 0]) @ body.normals[0]
    return bool(np.abs(offsets).max() <= _FLAT and (body.normals @ body.normals[0]).min() >= 0.999)


def _piece(body: RigidBody) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Lay out a flat body: its markers' corners (M, 4, 2), black cells (b, 4, 2), size (2,), mm.

    From its upper left corner, x right and y down as one sees it, with the white about it.
    """
    prints = body.prints
    marker = prints[-1]
    right = marker.along / np.linalg.norm(marker.along)
    axes = 1e3 * np.stack([right, np.cross(right, body.normals[-1])], axis=1)
    black = []
    for each in prints:
        rows, columns = each.cells.shape
        row, column = np.nonzero(~each.cells)
        across = (column[:, None] + [0, 1, 1, 0]) / columns
        down = (row[:, None] + [0, 0, 1, 1]) / rows
        places = across[..., None] * each.along + down[..., None] * each.down
        black.append((each.origin + places) @ axes)
    outlines = np.array([each.corners for each in prints]) @ axes
    low, high = outlines.min(axis=(0, 1)), outlines.max(axis=(0, 1))
    quiet = 1e3 * float(np.linalg.norm(marker.along)) / len(marker.cells)  # a cell
    move = quiet - low
    return body.corners @ axes + move, np.concatenate(black) + move, high - low + 2 * quiet


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


def _figure(sheet: Sheet) -> Figure:
    """Draw the sheet in its true size."""
    width, height = PAPERS[sheet.paper]
    figure = Figure(figsize=(width / 25.4, height / 25.4))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    # One outline of all, so that no viewer shows seams between neighbours.
    points = sheet.black[:, [0, 1, 2, 3, 0]].reshape(-1, 2)
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
