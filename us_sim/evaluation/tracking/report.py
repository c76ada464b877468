"""tracking.md: what was asked and seen, the tables, the pictures, and how it was measured.

What is asked of tracking, against what was seen in one run.

Pictures of error against distance, angle and run time, and of filters' lag against jitter.

A sheet of what is tracked: each body in each condition.

`us-sim evaluate tracking`: how wrong tracked poses are, and how long they take.

Bodies of markers are rendered as a camera sees them at known poses
(`us_sim.tracking.camera.rendered_views`), in short sequences as a hand moves them, and tracked as
`probe_tracker` does it. Filters are compared with the path to which noise was added for them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    failures,
    key_beside,
    markdown_table,
    new_figure,
    plain,
    save,
    target_table,
    words_of,
)
from us_sim.evaluation.timing import steps
from us_sim.evaluation.tracking.cases import (
    CONDITIONS,
    FRAMES,
    LARGE,
    MARKERS,
    RIGID_BODY,
    SINGLE,
    SMALL,
    Case,
    cases,
)
from us_sim.evaluation.tracking.filters import (
    FILTER_METHODS,
    FilterPoint,
    filter_point,
    filter_trials,
)
from us_sim.evaluation.tracking.measure import (
    Bench,
    Point,
    SmallMarkerPoint,
    View,
    small_marker_point,
    small_marker_trials,
    those,
    views_of,
)
from us_sim.tracking.camera.rendered_views import WEBCAMS, RenderedView

_OF_VIEWS = ("views", "found", "flipped", "mm", "95 %", "degrees", "95 %")


def table(points: Sequence[Point], small: Sequence[SmallMarkerPoint]) -> str:
    """What the command prints: every measure that is asked for, and what was seen."""
    return target_table([*targets(points), *small_marker_targets(small)])


def write_report(
    folder: ReportFolder,
    points: Sequence[Point],
    small: Sequence[SmallMarkerPoint],
    filters: Sequence[FilterPoint],
) -> None:
    """Draw the plots and write tracking.md."""
    plot_views(points, folder.picture("error"))
    plot_run_time(points, folder.picture("run_time"))
    plot_conditions(points, folder.picture("conditions"))
    plot_filters(filters, folder.picture("filters"))
    folder.write_report(_parts(folder, points, small, filters), failures(points))


def _parts(
    folder: ReportFolder,
    points: Sequence[Point],
    small: Sequence[SmallMarkerPoint],
    filters: Sequence[FilterPoint],
) -> list[str]:
    count = sum(len(point.views) for point in points)
    libraries = ("numpy", "numba", "opencv-python-headless", "opencv-python")
    return [
        "# Tracking: error against run time",
        folder.opening(*libraries, tables=("tracking", "small_markers", "filters")),
        f"{count:,} images of bodies of markers are rendered as cameras see them: every pixel that "
        "an edge crosses is the mean of 64 rays through a distorting lens; then come the lens's "
        "blur, a lamp beside the camera, and the sensor's noise and grey levels, before a room "
        "with things in it that have edges. What is compared is the known pose with what "
        "`probe_tracker`'s camera source measures.",
        "## What is asked",
        table(points, small),
        "Times are processor time of one thread, OpenCV's included. Other programs on the machine "
        "lengthen the wall clock (`ms_median` in the CSV), and processor time a little.",
        "## Bodies and conditions",
        "![Bodies and conditions](tracking_views.png)",
        "\n".join(f"- `{name}`: {kind.words}" for name, kind in MARKERS.items()),
        "\n".join(f"- {name}: {words}" for name, (_, words) in CONDITIONS.items()),
        "## Error against distance and angle",
        "![Error against distance and angle](tracking_error.png)",
        _bodies(points),
        "The position's error is of the body's middle. Flipped is a pose that is nearer to the "
        "true one's mirror image, tilted to the other side of the line of sight, and off by more "
        "than 5°.",
        "## Error against run time",
        "![Error against run time](tracking_run_time.png)",
        _times(points),
        "The detector looks at one whole image, of which nothing is known, and the solver finds "
        "the pose from its corners; a source that knows where the body was looks only there.",
        "## Conditions",
        "![Conditions](tracking_conditions.png)",
        _conditions(points),
        "A single marker that a hand touches is not found, and says so; a body of several is.",
        "## Small markers",
        _small(small),
        "One marker before the same room, tilted by up to 60°, under blur of 0.5 to 1.2 pixels "
        "and noise of 1 to 4 grey levels; sizes are those of an edge that faces the camera. The "
        "error is that of a marker's worst corner. What OpenCV finds and the whole pattern "
        "explains is kept; where an edge of up to 48 pixels tells nothing by itself, corners come "
        "from the pattern.",
        "## What the covariance says",
        _covariance(points),
        "Within is the fraction of errors inside the ellipsoid that the reported covariance says "
        "holds 95 % of them. More is caution: the covariance assumes at least "
        "`camera.corner_deviation` (0.1 pixels) for a corner, for real lenses, prints and "
        "calibrations are not as good as rendered ones.",
        "## Filters: lag against jitter",
        "![Filters](tracking_filters.png)",
        _filters(filters),
        "A hand sways by 35 mm and 14°, with a tremor, then rests; 60 poses a second have a noise "
        "of 0.3 mm and 0.2° in each coordinate. Lag is the shift in time by which the filtered "
        "path fits the true one best, jitter at rest and in motion what is left without it, error "
        "what is off at the very moment. The lag stated is the filter's own word, the median in "
        "motion.",
        "## How it was measured",
        f"A case's views come in sequences of {FRAMES} at 30 a second, in which a hand moves the "
        "body by 50 mm/s and 0.2 rad/s; each starts with a tracker that knows nothing. Bodies are "
        "in the middle quarter of the image, turned by any angle about the line of sight and "
        "tilted towards any side. Views of the same case have different noise, hands and light.",
    ]


def _bodies(points: Sequence[Point]) -> str:
    rows = []
    plain = [p for p in those(points, condition="plain") if p.views]
    for name in MARKERS:
        for size in dict.fromkeys(p.case.image_size for p in plain):
            for distance in sorted({p.case.distance for p in plain}):
                mine = views_of(plain, marker=name, image_size=size, distance=distance)
                if mine:
                    rows.append((name, size, f"{distance:g}", *_cells(mine)))
    return markdown_table(("body", "image", "m", *_OF_VIEWS), rows)


def _cells(views: Sequence[View]) -> tuple[str, ...]:
    """The cells of the columns `_OF_VIEWS`."""
    found = [view for view in views if view.detected]
    return (
        *(f"{len(views)}", _percent(len(found), len(views))),
        f"{sum(view.flipped for view in views)}",
        *_percentiles([view.mm for view in found]),
        *_percentiles([view.degrees for view in found]),
    )


def _times(points: Sequence[Point]) -> str:
    head = ("body", "image", "CPU ms an image", "detector, CPU ms", "solver, CPU ms")
    rows = []
    plain = those(points, condition="plain", distance=0.4)
    for name in MARKERS:
        for size in dict.fromkeys(p.case.image_size for p in plain):
            mine = [p for p in those(plain, marker=name, image_size=size) if p.views]
            if mine:
                cells = [
                    [view.cpu_ms for p in mine for view in p.views],
                    [p.detector_cpu_ms for p in mine],
                    [p.pose_cpu_ms for p in mine],
                ]
                rows.append((name, size, *(f"{np.nanmedian(values):.2f}" for values in cells)))
    return markdown_table(head, rows)


def _conditions(points: Sequence[Point]) -> str:
    near = those(points, image_size=SMALL, distance=0.4)
    rows = [
        (name, condition, *_cells(views_of(near, marker=name, condition=condition)))
        for name in MARKERS
        for condition in CONDITIONS
    ]
    return markdown_table(("body", "condition", *_OF_VIEWS), rows)


def _small(points: Sequence[SmallMarkerPoint]) -> str:
    head = ("dictionary", "edge, px", "views", "found by OpenCV", "kept", "corner, px", "95 %")
    rows = [
        (
            p.dictionary,
            f"{p.edge_px:g}",
            f"{p.views}",
            f"{p.found_by_opencv}",
            f"{p.kept}",
            f"{p.median_px:.2f}",
            f"{p.p95_px:.2f}",
            f"{p.worst_px:.2f}",
            f"{p.opencv_p95_px:.2f}",
        )
        for p in points
    ]
    return markdown_table((*head, "largest", "95 % of OpenCV's own"), rows)


def _covariance(points: Sequence[Point]) -> str:
    head = ("body", "within the 95 % ellipsoid", "median error, mm", "said, mm")
    rows = []
    for name in MARKERS:
        plain = views_of(points, marker=name, condition="plain")
        mine = [view for view in plain if view.detected]
        within = _percent(sum(view.inside for view in mine), len(mine))
        error, _ = _percentiles([view.mm for view in mine])
        said, _ = _percentiles([view.expected_mm for view in mine])
        rows.append((name, within, error, said))
    return markdown_table(head, rows)


def _filters(points: Sequence[FilterPoint]) -> str:
    head = ("filter", "setting", "lag, ms", "stated, ms", "jitter at rest, mm", "in motion, mm")
    rows = [
        (
            f"**{p.method}**" if p.default else p.method,
            p.setting,
            f"{1e3 * p.lag:.1f}",
            f"{1e3 * p.stated:.1f}",
            f"{1e3 * p.jitter:.3f}",
            f"{1e3 * p.moving_jitter:.3f}",
            f"{1e3 * p.error:.3f}",
            f"{1e6 * p.seconds:.0f}",
        )
        for p in points
    ]
    return markdown_table((*head, "error, mm", "µs a pose"), rows)


def _percentiles(values: Sequence[float]) -> tuple[str, str]:
    if not len(values):
        return "", ""
    median, most = np.nanpercentile(values, [50, 95])
    return f"{median:.3g}", f"{most:.3g}"


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else ""


_BODY = {"marker": RIGID_BODY, "condition": "plain", "distance": 0.4}

_VISIBLE = 4  # markers


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    views = views_of(points, **_BODY, image_size=SMALL)
    body = [view for view in views if view.visible == _VISIBLE]
    single = views_of(points, marker=SINGLE, condition="plain")
    found = [view for view in single if view.detected]
    tracked = sum(view.detected for view in body)
    where = f"{_VISIBLE} visible 30 mm markers at 0.4 m, 640 × 480"
    return [
        Target.at_most(
            "ms an image of 640 × 480 on one core, body of 6 markers", 8, _ms(points, SMALL)
        ),
        Target.at_most("ms an image of 1920 × 1080 on one core", 20, _ms(points, LARGE)),
        Target(
            f"{where}: tracked of {len(body)} views",
            "all",
            f"{tracked}",
            tracked == len(body) if body else None,
        ),
        Target.at_most(f"{where}: mm, median", 0.3, _percentile(body, "mm", 50)),
        Target.at_most(f"{where}: mm, 95th percentile", 1.0, _percentile(body, "mm", 95)),
        Target.at_most(f"{where}: degrees, median", 0.2, _percentile(body, "degrees", 50)),
        Target.at_most(f"{where}: degrees, 95th percentile", 0.6, _percentile(body, "degrees", 95)),
        Target.at_most(
            f"{where}: flips", 0, sum(view.flipped for view in body) if body else np.nan
        ),
        Target.under(
            f"single 40 mm marker in plain views ({len(found)} of {len(single)} found): % flipped",
            0.5,
            100 * sum(view.flipped for view in found) / len(found) if found else np.nan,
        ),
    ]


def small_marker_targets(points: Sequence[SmallMarkerPoint]) -> list[Target]:
    """That no small marker is lost that OpenCV finds."""
    found, kept = (sum(getattr(p, name) for p in points) for name in ("found_by_opencv", "kept"))
    said = f"markers of 14 to 44 pixels: kept of {found} that OpenCV finds"
    return [Target(said, "all", f"{kept}", kept == found if found else None)]


def _ms(points: Sequence[Point], image_size: str) -> float:
    """Median processor time of plain images of the rigid body from 0.4 m."""
    mine = [view.cpu_ms for view in views_of(points, **_BODY, image_size=image_size)]
    return float(np.median(mine)) if mine else float("nan")


def _percentile(views: Sequence[View], name: str, percent: float) -> float:
    values = [getattr(view, name) for view in views if view.detected]
    return float(np.percentile(values, percent)) if values else float("nan")


_DISTANCE = 0.4  # m


def plot_views(points: Sequence[Point], file: Path) -> None:
    """Errors of position and rotation over the distance, and over the angle at 0.4 m."""
    figure = new_figure(
        10.5, 7.4, "Error of plain views, 640 × 480 (line: median; dashed: 95th percentile)"
    )
    plain = those(points, condition="plain", image_size=SMALL)
    panels = figure.subplots(2, 2, sharey="row")
    at = {
        "distance, m (30°)": (those(plain, angle=30), lambda p: p.case.distance),
        f"angle, degrees ({_DISTANCE:g} m)": (
            those(plain, distance=_DISTANCE),
            lambda p: p.case.angle,
        ),
    }
    for column, (label, (mine, across)) in enumerate(at.items()):
        _errors(panels[0, column], mine, across, Point.error)
        _errors(panels[1, column], mine, across, Point.turned)
        panels[1, column].set_xlabel(label)
    panels[0, 0].set_ylabel("position, mm")
    panels[1, 0].set_ylabel("rotation, degrees")
    distances = sorted({p.case.distance for p in plain})
    for panel in panels[:, 0]:
        panel.set_xscale("log")
        panel.set_xticks(distances, [f"{value:g}" for value in distances])
        panel.xaxis.set_minor_formatter(NullFormatter())
    key_beside(panels[0, 1])
    save(figure, file)


def plot_run_time(points: Sequence[Point], file: Path) -> None:
    """Median error against processor time: every body at 0.4 m, in images of both sizes."""
    figure = new_figure(
        10.5, 4.6, "Error against run time at 0.4 m (full: 640 × 480; hollow: 1920 × 1080)"
    )
    panels = figure.subplots(1, 2, sharex=True)
    mine = those(points, condition="plain", distance=_DISTANCE)
    for panel, value, label in (
        (panels[0], Point.error, "position, mm (median)"),
        (panels[1], Point.turned, "rotation, degrees (median)"),
    ):
        for name, kind in MARKERS.items():
            for size in (SMALL, LARGE):
                some = those(mine, marker=name, image_size=size)
                fill = kind.colour if size == SMALL else "white"
                panel.plot(
                    [p.cpu_ms for p in some],
                    [value(p, 50) for p in some],
                    kind.mark,
                    mfc=fill,
                    mec=kind.colour,
                    ms=7,
                    label=name if size == SMALL else None,
                )
        panel.set(xlabel="processor time of an image, ms (median)", ylabel=label)
        panel.set(xscale="log", yscale="log")
        _plain(panel)
    key_beside(panels[1])
    save(figure, file)


def plot_conditions(points: Sequence[Point], file: Path) -> None:
    """Error, and how many views in a hundred show the body to the tracker, in every condition."""
    figure = new_figure(10.5, 6.6, "Conditions at 0.4 m and 30°, 640 × 480")
    panels = figure.subplots(3, 1, sharex=True)
    mine = those(points, image_size=SMALL, distance=_DISTANCE, angle=30)
    places = np.arange(len(CONDITIONS))
    width = 0.8 / len(MARKERS)
    for number, (name, kind) in enumerate(MARKERS.items()):
        columns: list[tuple[float, float, float]] = []
        for condition in CONDITIONS:
            columns.append((np.nan,) * 3)
            for p in those(mine, marker=name, condition=condition)[:1]:
                percent = 100 * len(p.found) / max(1, len(p.views))
                columns[-1] = (p.error(95), p.turned(95), percent)
        for panel, values in zip(panels, zip(*columns, strict=True), strict=True):
            at = places + (number - 0.5 * (len(MARKERS) - 1)) * width
            panel.bar(at, values, 0.9 * width, color=kind.colour, label=name)
    for panel, label in zip(panels, ("mm, 95 %", "degrees, 95 %", "found, %"), strict=True):
        panel.set_ylabel(label)
        if panel is not panels[2]:
            panel.set_yscale("log")
        _plain(panel)
    panels[2].set_xticks(places, list(CONDITIONS))
    key_beside(panels[0])
    save(figure, file)


def plot_filters(points: Sequence[FilterPoint], file: Path) -> None:
    """Lag in motion against what trembles at rest, and what is off at the very moment."""
    figure = new_figure(
        10.5, 4.6, "Filters at 60 poses a second (large and full: the default settings)"
    )
    panels = figure.subplots(1, 2)
    values: tuple[tuple[str, Callable[[FilterPoint], float]], ...] = (
        ("trembling at rest, mm (root mean square)", lambda p: 1e3 * p.jitter),
        ("error in motion at the very moment, mm", lambda p: 1e3 * p.error),
    )
    for panel, (label, value) in zip(panels, values, strict=True):
        for method, (colour, mark) in FILTER_METHODS.items():
            mine = [p for p in points if p.method == method]
            for p in mine:
                panel.plot(
                    max(1e3 * p.lag, 0.0),
                    value(p),
                    mark,
                    mec=colour,
                    mfc=colour if p.default else "white",
                    ms=11 if p.default else 5,
                    label=method if p is mine[0] else None,
                )
        panel.set_xscale("symlog", linthresh=1.0)
        panel.set(xlabel="lag in motion, ms", ylabel=label, yscale="log")
        _plain(panel)
    panels[1].legend(fontsize=8, frameon=False)
    save(figure, file)


def _errors(
    panel: Axes,
    points: Sequence[Point],
    across: Callable[[Point], float],
    value: Callable[[Point, float], float],
) -> None:
    for name, kind in MARKERS.items():
        mine = sorted((p for p in points if p.case.marker == name and p.found), key=across)
        x, colour = [across(p) for p in mine], kind.colour
        panel.plot(x, [value(p, 50) for p in mine], kind.mark + "-", color=colour, ms=5, label=name)
        panel.plot(x, [value(p, 95) for p in mine], "--", color=colour, lw=1, alpha=0.7)
    panel.set_yscale("log")
    _plain(panel)


def _plain(panel: Axes) -> None:
    plain(panel)
    for axis in (panel.xaxis, panel.yaxis):
        if axis.get_scale() == "log":
            axis.set_minor_formatter(FuncFormatter(_between_decades))
    panel.tick_params(which="minor", labelsize=7)


def _between_decades(value: float, _: object) -> str:
    """Twos and fives of a decade are named, so that a panel within one has numbers too."""
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""


_CUT = 240  # pixels, of the image around the body
_TITLE = 22  # pixels


def draw_views(file: Path) -> None:
    """Write a picture with a row for each condition and a column for each body."""
    rooms = {name: RenderedView(WEBCAMS[SMALL], MARKERS[name].body) for name in MARKERS}
    rows = []
    for condition, (settings, _) in CONDITIONS.items():
        cells = []
        for name in MARKERS:
            case = Case(name, SMALL, 0.4, 30.0, condition)
            pose, body = case.sequence(0)[0], MARKERS[name].body
            image = rooms[name].render(pose, settings, 3, case.motion(0))
            middle = WEBCAMS[SMALL].project(pose.apply(body.centres.mean(axis=0)[None]))[0]
            high, wide = image.shape
            top = int(np.clip(middle[1] - _CUT / 2, 0, high - _CUT))
            left = int(np.clip(middle[0] - _CUT / 2, 0, wide - _CUT))
            cells.append(_titled(image[top : top + _CUT, left : left + _CUT], name, condition))
        rows.append(np.hstack(cells))
    cv2.imwrite(str(file), np.vstack(rows))


def _titled(image: np.ndarray, name: str, condition: str) -> np.ndarray:
    strip = np.full((_TITLE, image.shape[1]), 255, dtype=np.uint8)
    text = f"{name}, {condition}"
    cv2.putText(strip, text, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 0, 1, cv2.LINE_AA)
    return np.vstack([strip, image])


_SEQUENCES, _QUICK_SEQUENCES = {SMALL: 12, LARGE: 8}, {SMALL: 5, LARGE: 3}
"""Sequences of views a case, by the size of the images."""
_MORE = 3  # times as many sequences of the cases that the targets are about


def evaluate_tracking(out: Path, quick: bool) -> int:
    """Write the CSV files, the pictures and tracking.md, as `us_sim.evaluation` says.

    A quick run has fewer distances, angles and views.
    """
    folder = ReportFolder("tracking", out, quick)
    bench = Bench()
    bench.warm_up()
    points = [_point(bench, case, quick) for case in steps("views", cases(quick), "cases")]
    trials = list(small_marker_trials(quick))
    small = [small_marker_point(*trial) for trial in steps("small markers", trials, "sizes")]
    filters = [filter_point(*trial) for trial in steps("filters", filter_trials(quick), "settings")]
    folder.write_rows("tracking", points)
    folder.write_rows("small_markers", small)
    folder.write_rows("filters", filters)
    draw_views(folder.picture("views"))
    write_report(folder, points, small, filters)
    return folder.finish(table(points, small), failures(points))


def _point(bench: Bench, case: Case, quick: bool) -> Point:
    sequences = (_QUICK_SEQUENCES if quick else _SEQUENCES)[case.image_size]
    if case.condition == "plain" and case.marker in (SINGLE, RIGID_BODY):
        sequences *= _MORE
    try:
        return bench.point(case, sequences)
    # Whatever breaks in one case must not take the others' results along.
    except Exception as error:
        return Point(case, failure=words_of(error))
