"""`us-sim evaluate tracking`: three CSV files, pictures, and tracking.md.

Bodies of markers are rendered as a camera sees them at known poses, in short sequences as a hand
moves them, and tracked as `probe_tracker` does it. Filters are compared with the path before noise
was added to it.
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
    percentile,
    picture,
    plain,
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
    select,
    small_marker_point,
    small_marker_trials,
    views_of,
)
from us_sim.tracking.camera.rendered_views import WEBCAMS, RenderedView

_QUICK_SEQUENCES = {SMALL: 5, LARGE: 3}  # sequences of views a case, by the size of the images

_OF_VIEWS = ("views", "found", "flipped", "mm", "95 %", "degrees", "95 %")


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
    table = target_table([*targets(points), _small_marker_target(small)])
    _draw_views(folder.picture("views"))
    _plot_views(points, folder.picture("error"))
    _plot_run_time(points, folder.picture("run_time"))
    _plot_conditions(points, folder.picture("conditions"))
    _plot_filters(filters, folder.picture("filters"))
    return folder.finish(
        table,
        failures(points),
        ("numpy", "numba", "opencv-python-headless", "opencv-python"),
        count=f"{sum(len(point.views) for point in points):,}",
        targets=table,
        markers="\n".join(f"- `{name}`: {kind.words}" for name, kind in MARKERS.items()),
        conditions_in_words="\n".join(f"- {name}: {s}" for name, (_, s) in CONDITIONS.items()),
        bodies=_bodies(points),
        times=_times(points),
        conditions=_conditions(points),
        small=_small(small),
        covariance=_covariance(points),
        filters=_filters(filters),
        frames=f"{FRAMES}",
    )


def _point(bench: Bench, case: Case, quick: bool) -> Point:
    sequences = (_QUICK_SEQUENCES if quick else {SMALL: 12, LARGE: 8})[case.image_size]
    if case.condition == "plain" and case.marker in (SINGLE, RIGID_BODY):
        sequences *= 3  # the targets are about these
    try:
        return bench.point(case, sequences)
    # Whatever breaks in one case must not take the others' results along.
    except Exception as error:
        return Point(case, failure=words_of(error))


def targets(points: Sequence[Point]) -> list[Target]:
    """Limits against the measured numbers."""
    near = {"marker": RIGID_BODY, "condition": "plain", "distance": 0.4}
    body = [view for view in views_of(points, **near, image_size=SMALL) if view.visible == 4]
    seen = [view for view in body if view.detected]
    single = views_of(points, marker=SINGLE, condition="plain")
    found = [view for view in single if view.detected]
    ms = {
        size: percentile([view.cpu_ms for view in views_of(points, **near, image_size=size)], 50)
        for size in (SMALL, LARGE)
    }
    where = "4 visible 30 mm markers at 0.4 m, 640 × 480"
    flips = sum(view.flipped for view in body) if body else np.nan
    percent = 100 * sum(view.flipped for view in found) / len(found) if found else np.nan
    return [
        Target.at_most("ms an image of 640 × 480 on one core, body of 6 markers", 8, ms[SMALL]),
        Target.at_most("ms an image of 1920 × 1080 on one core", 20, ms[LARGE]),
        Target(
            f"{where}: tracked of {len(body)} views",
            "all",
            f"{len(seen)}",
            len(seen) == len(body) if body else None,
        ),
        *(
            Target.at_most(
                f"{where}: {unit}, {words}",
                limit,
                percentile([getattr(view, unit) for view in seen], part),
            )
            for unit, words, limit, part in (
                ("mm", "median", 0.3, 50),
                ("mm", "95th percentile", 1.0, 95),
                ("degrees", "median", 0.2, 50),
                ("degrees", "95th percentile", 0.6, 95),
            )
        ),
        Target.at_most(f"{where}: flips", 0, flips),
        Target.under(
            f"single 40 mm marker in plain views ({len(found)} of {len(single)} found): % flipped",
            0.5,
            percent,
        ),
    ]


def _small_marker_target(points: Sequence[SmallMarkerPoint]) -> Target:
    """No small marker is lost that OpenCV finds."""
    found, kept = (sum(getattr(p, name) for p in points) for name in ("found_by_opencv", "kept"))
    said = f"markers of 14 to 44 pixels: kept of {found} that OpenCV finds"
    return Target(said, "all", f"{kept}", kept == found if found else None)


def _draw_views(file: Path) -> None:
    """A row for each condition and a column for each body, cut from the image around it."""
    cut = 240  # pixels
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
            top = int(np.clip(middle[1] - cut / 2, 0, high - cut))
            left = int(np.clip(middle[0] - cut / 2, 0, wide - cut))
            strip = np.full((22, cut), 255, dtype=np.uint8)
            text, font = f"{name}, {condition}", cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(strip, text, (6, 15), font, 0.45, 0, 1, cv2.LINE_AA)
            cells.append(np.vstack([strip, image[top : top + cut, left : left + cut]]))
        rows.append(np.hstack(cells))
    cv2.imwrite(str(file), np.vstack(rows))


def _plot_views(points: Sequence[Point], file: Path) -> None:
    """Errors of position and rotation over the distance, and over the angle at 0.4 m."""
    views = select(points, condition="plain", image_size=SMALL)
    at: dict[str, tuple[list[Point], Callable[[Point], float]]] = {
        "distance, m (30°)": (select(views, angle=30), lambda p: p.case.distance),
        "angle, degrees (0.4 m)": (select(views, distance=0.4), lambda p: p.case.angle),
    }
    title = "Error of plain views, 640 × 480 (line: median; dashed: 95th percentile)"
    with picture(file, 10.5, 7.4, title) as figure:
        panels = figure.subplots(2, 2, sharey="row")
        for column, (label, (mine, across)) in zip(panels.T, at.items(), strict=True):
            _draw_errors(column[0], mine, across, Point.error)
            _draw_errors(column[1], mine, across, Point.turned)
            column[1].set_xlabel(label)
        panels[0, 0].set_ylabel("position, mm")
        panels[1, 0].set_ylabel("rotation, degrees")
        distances = sorted({p.case.distance for p in views})
        for panel in panels[:, 0]:
            panel.set_xscale("log")
            panel.set_xticks(distances, [f"{value:g}" for value in distances])
            panel.xaxis.set_minor_formatter(NullFormatter())
        key_beside(panels[0, 1])


def _draw_errors(
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
    """As `plain`, with numbers at twos and fives of a decade, for panels within one."""

    def between_decades(value: float, _: object) -> str:
        return f"{value:g}" if f"{value:e}"[0] in "25" else ""

    plain(panel)
    for axis in (panel.xaxis, panel.yaxis):
        if axis.get_scale() == "log":
            axis.set_minor_formatter(FuncFormatter(between_decades))
    panel.tick_params(which="minor", labelsize=7)


def _plot_run_time(points: Sequence[Point], file: Path) -> None:
    """Median error against processor time: every body at 0.4 m, in images of both sizes."""
    mine = select(points, condition="plain", distance=0.4)
    title = "Error against run time at 0.4 m (full: 640 × 480; hollow: 1920 × 1080)"
    with picture(file, 10.5, 4.6, title) as figure:
        panels = figure.subplots(1, 2, sharex=True)
        for panel, value, label in (
            (panels[0], Point.error, "position, mm (median)"),
            (panels[1], Point.turned, "rotation, degrees (median)"),
        ):
            for name, kind in MARKERS.items():
                for size in (SMALL, LARGE):
                    some = select(mine, marker=name, image_size=size)
                    panel.plot(
                        [p.cpu_ms for p in some],
                        [value(p, 50) for p in some],
                        kind.mark,
                        mfc=kind.colour if size == SMALL else "white",
                        mec=kind.colour,
                        ms=7,
                        label=name if size == SMALL else None,
                    )
            panel.set(xlabel="processor time of an image, ms (median)", ylabel=label)
            panel.set(xscale="log", yscale="log")
            _plain(panel)
        key_beside(panels[1])


def _plot_conditions(points: Sequence[Point], file: Path) -> None:
    """Error, and how many views in a hundred show the body to the tracker, in every condition."""
    mine = select(points, image_size=SMALL, distance=0.4, angle=30)
    places, width = np.arange(len(CONDITIONS)), 0.8 / len(MARKERS)
    with picture(file, 10.5, 6.6, "Conditions at 0.4 m and 30°, 640 × 480") as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for place, (name, kind) in enumerate(MARKERS.items()):
            columns: list[tuple[float, float, float]] = []
            for condition in CONDITIONS:
                columns.append((np.nan,) * 3)
                for p in select(mine, marker=name, condition=condition)[:1]:
                    percent = 100 * len(p.found) / max(1, len(p.views))
                    columns[-1] = (p.error(95), p.turned(95), percent)
            at = places + (place - 0.5 * (len(MARKERS) - 1)) * width
            for panel, values in zip(panels, zip(*columns, strict=True), strict=True):
                panel.bar(at, values, 0.9 * width, color=kind.colour, label=name)
        for panel, label in zip(panels, ("mm, 95 %", "degrees, 95 %", "found, %"), strict=True):
            panel.set_ylabel(label)
            if panel is not panels[2]:
                panel.set_yscale("log")
            _plain(panel)
        panels[2].set_xticks(places, list(CONDITIONS))
        key_beside(panels[0])


def _plot_filters(points: Sequence[FilterPoint], file: Path) -> None:
    """Lag in motion against the jitter at rest, and against the error at the very moment."""
    values: tuple[tuple[str, Callable[[FilterPoint], float]], ...] = (
        ("trembling at rest, mm (root mean square)", lambda p: 1e3 * p.jitter),
        ("error in motion at the very moment, mm", lambda p: 1e3 * p.error),
    )
    title = "Filters at 60 poses a second (large and full: the default settings)"
    with picture(file, 10.5, 4.6, title) as figure:
        panels = figure.subplots(1, 2)
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


def _bodies(points: Sequence[Point]) -> str:
    rows = []
    views = [p for p in select(points, condition="plain") if p.views]
    for name in MARKERS:
        for size in dict.fromkeys(p.case.image_size for p in views):
            for distance in sorted({p.case.distance for p in views}):
                mine = views_of(views, marker=name, image_size=size, distance=distance)
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
    near = select(points, condition="plain", distance=0.4)
    for name in MARKERS:
        for size in dict.fromkeys(p.case.image_size for p in near):
            mine = [p for p in select(near, marker=name, image_size=size) if p.views]
            if mine:
                cells = [
                    [view.cpu_ms for p in mine for view in p.views],
                    [p.detector_cpu_ms for p in mine],
                    [p.pose_cpu_ms for p in mine],
                ]
                rows.append((name, size, *(f"{np.nanmedian(values):.2f}" for values in cells)))
    return markdown_table(head, rows)


def _conditions(points: Sequence[Point]) -> str:
    near = select(points, image_size=SMALL, distance=0.4)
    rows = [
        (name, condition, *_cells(views_of(near, marker=name, condition=condition)))
        for name in MARKERS
        for condition in CONDITIONS
    ]
    return markdown_table(("body", "condition", *_OF_VIEWS), rows)


def _small(points: Sequence[SmallMarkerPoint]) -> str:
    head = ("dictionary", "edge, px", "views", "found by OpenCV", "kept", "corner, px", "95 %")
    rows = []
    for p in points:
        errors = (p.median_px, p.p95_px, p.worst_px, p.opencv_p95_px)
        counts = (p.views, p.found_by_opencv, p.kept)
        cells = [*map(str, counts), *(f"{pixels:.2f}" for pixels in errors)]
        rows.append((p.dictionary, f"{p.edge_px:g}", *cells))
    return markdown_table((*head, "largest", "95 % of OpenCV's own"), rows)


def _covariance(points: Sequence[Point]) -> str:
    head = ("body", "within the 95 % ellipsoid", "median error, mm", "said, mm")
    rows = []
    for name in MARKERS:
        views = views_of(points, marker=name, condition="plain")
        mine = [view for view in views if view.detected]
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
            *(f"{1e3 * seconds:.1f}" for seconds in (p.lag, p.stated)),
            *(f"{1e3 * metres:.3f}" for metres in (p.jitter, p.moving_jitter, p.error)),
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
