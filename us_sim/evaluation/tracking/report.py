"""tracking.md: what was asked and seen, the tables, the pictures, and how it was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.target import target_table
from us_sim.evaluation.tracking.cases import CONDITIONS, FRAMES, MARKERS, SMALL
from us_sim.evaluation.tracking.filters import FilterPoint
from us_sim.evaluation.tracking.plots import (
    plot_conditions,
    plot_filters,
    plot_run_time,
    plot_views,
)
from us_sim.evaluation.tracking.points import Point, View, those, views_of
from us_sim.evaluation.tracking.small_markers import SmallMarkerPoint
from us_sim.evaluation.tracking.targets import small_marker_targets, targets

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
