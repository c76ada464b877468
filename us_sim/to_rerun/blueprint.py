"""What the viewer opens: the scene in three dimensions, the image, curves and states."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import rerun.blueprint as views
from rerun.encodings import AbsoluteTimeRange

from us_sim.to_rerun.diagnostics import CURVES
from us_sim.to_rerun.images import IMAGE
from us_sim.to_rerun.rerun_file import STAMP

_BACKGROUND = (14, 17, 19)
_FROM, _AT, _UP = (0.11, -0.16, -0.11), (0.0, 0.0, 0.012), (0.0, 0.0, -1.0)
"""Where the eye is, what it looks at, and what is up, in `patient`, m: +z is into the tissue."""
_TITLES = {
    "rate": "Rates, Hz",
    "latency": "Latency of the nodes, ms",
    "residual": "Residuals",
}


def blueprint_of(
    shown: Collection[str], images: Collection[str], frame: str, span: tuple[int, int] | None
) -> Any:
    """Views of what is there.

    Args:
        shown: entities of topics that have messages.
        images: those of them that are images.
        frame: that the scene is seen in.
        span: ns since 1970, from the first stamp of a pose to the last, which is played; None where
            there are none.
    """
    scene = views.Spatial3DView(
        origin="/",
        name="Scene",
        contents=["/**", *(f"- /{image}" for image in images), "- /diagnostics/**"],
        spatial_information=views.SpatialInformation(frame),
        background=_BACKGROUND,
        line_grid=False,
        eye_controls=views.EyeControls3D(position=_FROM, look_target=_AT, eye_up=_UP),
    )
    ordered = sorted(images, key=lambda image: (image != IMAGE, image))
    beside = [views.Spatial2DView(origin=image, name=image) for image in ordered]
    curves = []
    if "probe/wrench" in shown:
        curves.append(views.TimeSeriesView(origin="probe/wrench", name="Force on the probe, N"))
    if "diagnostics" in shown:
        curves += [
            views.TimeSeriesView(origin=f"diagnostics/{curve}", name=_TITLES[curve])
            for curve in CURVES.values()
        ]
        curves.append(views.TextLogView(origin="diagnostics/state", name="States"))
    right = []
    if beside:
        right.append(views.Tabs(*beside, active_tab=0))
    if curves:
        right.append(views.Tabs(*curves, active_tab=0))
    whole = views.Horizontal(scene, views.Vertical(*right, row_shares=[2, 1][: len(right)]))
    selection = None if span is None else AbsoluteTimeRange(*span)
    time = views.TimePanel(
        timeline=STAMP,
        time_selection=selection,
        loop_mode=None if span is None else "selection",
        state="collapsed",
    )
    return views.Blueprint(whole if right else scene, time, collapse_panels=True)
