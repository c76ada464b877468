"""Drawing over an ultrasound image: scales, the focus, outlines, and a badge when it is not live.

>>> import numpy as np
>>> from us_sim.slicing.drawing.annotation import Annotation, Badge
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> probe = LinearProbe(aperture=0.04, depth=0.05, columns=400, rows=500)
>>> annotation = Annotation(probe, {5: ("vein", (0.25, 0.4, 0.85))})
>>> badge = Badge("LOST", (230, 40, 40))
>>> annotation.draw_annotated(np.zeros((500, 400), np.uint8), badge=badge).shape
(500, 400, 3)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.drawing.label_outlines import Refine, trace_label_outlines
from us_sim.slicing.drawing.overlay import Colour, ColourBar, TextPatch, mirror_line, render_text

if TYPE_CHECKING:
    from us_sim.slicing.drawing.overlay import Overlay
    from us_sim.slicing.probe.probe import Probe

_SCALE: Colour = (205, 215, 215)
_FOCUS: Colour = (255, 210, 60)
_SHADOW: Colour = (0, 0, 0)
_FINE = 4  # bits of the fraction of a pixel in the coordinates of outlines
Box = tuple[int, int, int, int]  # left, top, right, bottom


@dataclass(frozen=True)
class Badge:
    """A word across the image that is not live, in the colour of the frame around it."""

    text: str
    colour: Colour


class Annotation:
    """Draws over the images of one probe.

    Args:
        probe: its ``image_to_probe``, columns, rows and focus are read.
        structures: name and colour (red, green, blue, 0 to 1) of each label to be outlined.
        is_flipped: exchange left and right of all but what is written, which says so then.
    """

    def __init__(
        self,
        probe: Probe,
        structures: Mapping[int, tuple[str, tuple[float, float, float]]],
        *,
        is_flipped: bool = False,
    ) -> None:
        self.is_flipped = is_flipped
        self._rows, self._columns = probe.rows, probe.columns
        self._picture: Box = (0, 0, self._columns, self._rows)
        self._text = int(np.clip(round(min(self._rows, self._columns) / 40), 8, 48))
        self._line = max(1, round(self._text / 12))
        self._frame = max(2, self._text // 3)
        self._structures = {
            label: (name, _bright(colour)) for label, (name, colour) in structures.items()
        }
        self._ticks: list[NDArray[np.int32]] = []
        self._labels: list[tuple[TextPatch, int, int]] = []
        self._occupied: list[Box] = []
        self._focus: NDArray[np.int32] | None = None
        matrix = probe.image_to_probe
        self._lay_out_depth(matrix[2, 3], matrix[2, 1])
        if probe.focus is not None:
            self._lay_out_focus(round((probe.focus - matrix[2, 3]) / matrix[2, 1]))
        self._lay_out_width(matrix[0, 3], matrix[0, 0])
        if is_flipped:
            label = render_text("flipped", self._text, _FOCUS)
            self._place(label, self._columns - 6 * self._text - label.width, self._frame)

    def draw_annotated(
        self,
        pixels: NDArray[np.uint8],
        labels: NDArray[np.uint8] | None = None,
        badge: Badge | None = None,
        overlay: Overlay | None = None,
        lines: Sequence[NDArray[np.floating]] = (),
        refine: Refine | None = None,
    ) -> NDArray[np.uint8]:
        """Draw a new (rows, columns, 3) picture of red, green and blue.

        Args:
            pixels: (rows, columns) grey.
            labels: (rows, columns), where outlines are wanted.
            badge: where the image is not live.
            overlay: colours over the grey, below all else, and their bar.
            lines: (N, 2) column and row, such as a gate's.
            refine: of the labels' outlines, as for `label_outlines`.

        All are as in an image that is not flipped.
        """
        if self.is_flipped:
            pixels = np.ascontiguousarray(pixels[:, ::-1])
            overlay = None if overlay is None else overlay.flip_horizontally()
            lines = [mirror_line(line, self._columns) for line in lines]
        picture = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        bar = None
        if overlay is not None:
            overlay.blend_into(picture)
            bar = ColourBar(overlay.scale, self._text, overlay.note)
            if overlay.outline is not None:
                corners = _fine(overlay.outline)
                cv2.polylines(picture, [corners], True, _SCALE, self._line, cv2.LINE_AA, _FINE)
        drawn = [_fine(line) for line in lines]
        cv2.polylines(picture, drawn, False, _SHADOW, self._line + 2, cv2.LINE_AA, _FINE)
        cv2.polylines(picture, drawn, False, _FOCUS, self._line, cv2.LINE_AA, _FINE)
        if labels is not None:
            self._outline(picture, labels, [bar.box] if bar else [], refine)
        if bar is not None:
            bar.draw(picture)
        cv2.polylines(picture, self._ticks, False, _SHADOW, self._line + 2)
        cv2.polylines(picture, self._ticks, False, _SCALE, self._line)
        if self._focus is not None:
            cv2.fillPoly(picture, [self._focus], _FOCUS, cv2.LINE_AA)
            cv2.polylines(picture, [self._focus], True, _SHADOW, 1, cv2.LINE_AA)
        for label, column, row in self._labels:
            label.draw_at(picture, column, row)
        if badge is not None:
            self._mark(picture, badge)
        return picture

    def _lay_out_depth(self, first: float, spacing: float) -> None:
        step, between = _steps(spacing, self._rows, 2.2 * self._text)
        edge = self._columns - 1
        for depth in _multiples(between, max(first - spacing, 0.0), first + self._rows * spacing):
            row = int(np.clip(round((depth - first) / spacing), 0, self._rows - 1))
            labelled = abs(depth / step - round(depth / step)) < 1e-6
            length = self._text if labelled else self._text // 2
            self._ticks.append(np.array([[edge - length, row], [edge, row]], np.int32))
            if labelled:
                text = f"{1e3 * depth:g}" + (" mm" if depth == 0 else "")
                label = render_text(text, self._text, _SCALE)
                lowest = self._rows - self._frame - label.height
                top = max(self._frame, min(row - label.height // 2, lowest))
                self._place(label, edge - self._text - 2 - label.width, top)

    def _lay_out_width(self, first: float, spacing: float) -> None:
        widest = render_text(f"-{900 * abs(first):.0f}", self._text, _SCALE).width
        if self.is_flipped:
            first = first + (self._columns - 1) * spacing
            spacing = -spacing
        step, between = _steps(abs(spacing), self._columns, 1.5 * widest)
        edge = self._rows - 1
        above = edge - self._text
        beside_depth = self._columns - 2 * self._text
        last = first + (self._columns - 1) * spacing
        for x in _multiples(between, min(first, last), max(first, last)):
            column = round((x - first) / spacing)
            if column >= beside_depth or _is_taken((column, above, column, edge), self._occupied):
                continue
            labelled = abs(x / step - round(x / step)) < 1e-6
            length = self._text if labelled else self._text // 2
            self._ticks.append(np.array([[column, edge - length], [column, edge]], np.int32))
            if labelled:
                label = render_text(f"{1e3 * x:g}", self._text, _SCALE)
                self._place(label, column - label.width // 2, above - 2 - label.height)

    def _lay_out_focus(self, row: int) -> None:
        """Lay out a triangle that points at the focus on the depth scale."""
        if not 0 <= row < self._rows:
            return
        size = max(3, round(0.6 * self._text))
        across = (0, row - size, self._columns, row + size)
        edge = self._columns - 1 - self._text
        tip = min([edge, *(box[0] for box in self._occupied if _overlap(box, across))]) - 2
        self._focus = np.array(
            [[tip, row], [tip - size, row - size], [tip - size, row + size]], np.int32
        )

    def _place(self, label: TextPatch, column: int, row: int) -> None:
        """Have every picture show a label, if that lies inside and on no other."""
        box = _box(label, column, row)
        if _lies_in(box, self._picture) and not _is_taken(box, self._occupied):
            self._labels.append((label, column, row))
            self._occupied.append(box)

    def _outline(
        self,
        picture: NDArray[np.uint8],
        labels: NDArray[np.uint8],
        drawn: list[Box],
        refine: Refine | None,
    ) -> None:
        """Draw thin outlines of the structures, and each name once, at its longest outline."""
        named: list[tuple[TextPatch, Box]] = []
        for number, (name, colour) in self._structures.items():
            smoothing = self._text / 2.5
            outlines = trace_label_outlines(labels, number, smoothing=smoothing, refine=refine)
            if not outlines:
                continue
            if self.is_flipped:
                outlines = [
                    np.asarray(mirror_line(each, self._columns), float) for each in outlines
                ]
            chains = [_fine(outline) for outline in outlines]
            cv2.polylines(picture, chains, True, colour, self._line, cv2.LINE_AA, _FINE)
            left, top = np.floor(outlines[0].min(axis=0)).astype(int).tolist()
            right, bottom = np.ceil(outlines[0].max(axis=0)).astype(int).tolist()
            named.append((render_text(name, self._text, colour), (left, top, right, bottom)))
        taken = [*self._occupied, *drawn]
        around = [box for _, box in named]
        for label, outline in named:
            places = self._beside(label, outline)
            free = [box for box in places if not _is_taken(box, taken)]
            clear = [box for box in free if not _is_taken(box, around)]
            for box in clear[:1] or free[:1]:
                label.draw_at(picture, box[0], box[1])
                taken.append(box)

    def _beside(self, label: TextPatch, outline: Box) -> list[Box]:
        """Return boxes for a name: above the outline, below, right, left, and in its middle."""
        left, top, right, bottom = outline
        column = max(0, min((left + right - label.width) // 2, self._columns - label.width))
        row = max(0, min((top + bottom - label.height) // 2, self._rows - label.height))
        places = [
            (column, top - label.height),
            (column, bottom + 1),
            (right + 2, row),
            (left - label.width - 1, row),
            (column, row),
        ]
        boxes = [_box(label, *place) for place in places]
        return [box for box in boxes if _lies_in(box, self._picture)]

    def _mark(self, picture: NDArray[np.uint8], badge: Badge) -> None:
        """Draw a frame around the picture and the badge's text at its top."""
        width = self._frame
        for height in range(2 * self._text, 5, -1):
            label = render_text(badge.text, height, badge.colour)
            if label.draw_at(picture, (self._columns - label.width) // 2, width):
                break
        picture[:width] = picture[-width:] = badge.colour
        picture[:, :width] = picture[:, -width:] = badge.colour


def _fine(line: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.rint(line * (1 << _FINE)).astype(np.int32)


def _bright(colour: tuple[float, float, float]) -> Colour:
    red, green, blue = (round(255 * (0.25 + 0.75 * level)) for level in colour)
    return red, green, blue


def _steps(spacing: float, count: int, pixels: float) -> tuple[float, float]:
    """Return the distances (m) of labels, at least so many pixels apart, and of ticks.

    Labels are 5, 10, 20, 50, … mm apart, in a very small image 1, 2, 5, … mm.
    """
    step, between = (5e-3, 1e-3) if count * spacing >= 15e-3 else (1e-3, 5e-4)
    coarser = {1: (2e-3, 1e-3), 2: (5e-3, 1e-3), 5: (1e-2, 5e-3)}
    scale = 1.0
    while step / spacing < pixels:
        digit = round(1e3 * step / scale)
        step, between = (scale * length for length in coarser[digit])
        if digit == 5:
            scale *= 10
    return step, between if between / spacing >= 4 else step


def _multiples(step: float, lowest: float, highest: float) -> NDArray[np.float64]:
    first, last = np.ceil(lowest / step - 1e-6), np.floor(highest / step + 1e-6)
    return np.arange(first, last + 1) * step + 0.0  # without -0


def _box(label: TextPatch, column: int, row: int) -> Box:
    return column, row, column + label.width, row + label.height


def _lies_in(one: Box, other: Box) -> bool:
    return other[0] <= one[0] and other[1] <= one[1] and one[2] <= other[2] and one[3] <= other[3]


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _is_taken(box: Box, taken: list[Box]) -> bool:
    return any(_overlap(box, other) for other in taken)
