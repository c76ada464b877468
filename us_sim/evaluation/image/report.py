"""`us-sim evaluate image`: sound, strain and flow in images, against closed forms."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from us_sim.evaluation.figures import draw_image_grid, draw_lines
from us_sim.evaluation.image.acoustics import (
    attenuation_rows,
    fibre_rows,
    shadow_rows,
    surface_rows,
)
from us_sim.evaluation.image.arm import arm_rows, run_time_rows
from us_sim.evaluation.image.flow import flow_rows
from us_sim.evaluation.image.strain import strain_rows
from us_sim.evaluation.subject import Piece, Report, Subject, Target

ARTEFACTS: Mapping[str, Callable[[bool], Iterable[Mapping[str, Any]]]] = {
    "attenuation": attenuation_rows,
    "shadow_edge": shadow_rows,
    "surface": surface_rows,
    "anisotropy": fibre_rows,
    "arm": arm_rows,
    "strain": strain_rows,
    "flow": flow_rows,
    "run_time": run_time_rows,
}
"""By the first word of their rows, in the order of the report."""


def _pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    return {
        "image": [
            Piece({"artefact": name}, partial(rows, quick)) for name, rows in ARTEFACTS.items()
        ]
    }


class _Table:
    """Rows of the table by their artefact; what failed is not known."""

    def __init__(self, table: pd.DataFrame) -> None:
        off = (table["measured"] - table["expected"]).abs()
        self.table = table.assign(off=off, percent=table["error_percent"].abs())

    def rows(self, artefact: str) -> pd.DataFrame:
        """Those whose artefact begins so."""
        return self.table[self.table["artefact"].str.startswith(artefact)]

    def worst(self, artefact: str, column: str = "percent") -> float:
        """The greatest of an error."""
        return float(self.rows(artefact)[column].max())

    def ms(self, artefact: str) -> float:
        """Median processor time of an image."""
        return float(self.rows(artefact)["ms_median"].max())


def targets(table: pd.DataFrame) -> list[Target]:
    """Limits against the measured numbers."""
    image = _Table(table)
    loss = image.rows("attenuation").groupby("probe")["percent"].max()
    found = [
        *(
            Target.at_most(
                f"loss in layers, {probe} probe, tilted up to 40°: amplitude, worst depth",
                1.0,
                loss.get(probe, np.nan),
                "%",
            )
            for probe in ("linear", "convex", "sector")
        ),
        *(
            Target.at_most(
                f"shadow of bone, {state}: pixels from its geometric edge, worst",
                1.0,
                image.worst(f"shadow_edge_{state}", "off"),
            )
            for state in ("rest", "pressed", "slid")
        ),
    ]
    times = {name: image.ms(f"run_time_{name}") for name in ("slice", "all")}
    strain_ratio = image.ms("strain_image") / image.ms("strain_none")
    colour_ratio = image.ms("flow_cost_on") / image.ms("flow_cost_off")
    limits: Sequence[tuple[str, float, float, str]] = (
        ("echo of a border by its angle: off by most", 1.0, image.worst("surface", "off"), "dB"),
        ("echo of fibres by their angle: likewise", 0.1, image.worst("anisotropy", "off"), "dB"),
        ("the arm, gain against rays: median", 0.2, image.worst("arm_median", "off"), "dB"),
        ("likewise, 95th percentile", 3.0, image.worst("arm_p95", "off"), "dB"),
        ("strain of a block, worst pixel", 2.0, image.worst("strain_block"), "%"),
        ("displacement, likewise", 2.0, image.worst("displacement_block"), "%"),
        ("slice with strain, over the plain slice", 2.22, strain_ratio, ""),
        ("flow through a plane across the vessel", 3.0, image.worst("flow_rate"), "%"),
        ("velocity in a vein that is pressed flat", 0.0, image.worst("flow_closed", "off"), "m/s"),
        ("image with colour in a quarter of it, over one without", 3.3, colour_ratio, ""),
        ("image of 512 × 512 with all acoustics, one core", 1.5, times["all"], "ms"),
        ("as many times what the slice alone takes", 1.67, times["all"] / times["slice"], ""),
    )
    return found + [Target.at_most(*limit) for limit in limits]


def _report(table: pd.DataFrame) -> Report:
    image = _Table(table)
    estimate = image.rows("strain_estimate")
    timed = image.rows("run_time")
    slice_ms = image.ms("run_time_slice")
    take_home = [
        f"Loss through layers is {image.worst('attenuation'):.2g} % off in amplitude at worst, "
        f"and a shadow's edge {image.worst('shadow_edge', 'off'):.2g} pixels, at rest and pressed.",
        f"Echoes of borders and fibres follow the angle of the beam within "
        f"{image.worst('surface', 'off'):.2g} and {image.worst('anisotropy', 'off'):.1g} dB; an "
        f"arm's gain is {image.worst('arm_median', 'off'):.2g} dB from cast rays (median).",
        f"Strain of a homogeneous block is exact ({image.worst('strain_block'):.1g} %); an "
        f"estimate from two images is {image.worst('strain_estimate_rms'):.2g} % of it off.",
        f"The flow through a plane is {image.worst('flow_rate'):.2g} % from Poiseuille's at worst.",
        f"An image of 512 × 512 takes {slice_ms:.2f} ms of a core, with all acoustics "
        f"{image.ms('run_time_all'):.2f} ms, with colour {image.ms('flow_cost_on'):.2f} ms.",
    ]
    places = {
        "attenuation": _draw_attenuation(image.rows("attenuation")),
        "shadow": draw_lines(
            image.rows("shadow_edge").assign(pixels=lambda t: t["measured"] - t["expected"]),
            "tilt_deg",
            "pixels",
            "A shadow's edge: pixels from the geometric one",
            panels="probe",
            lines="artefact",
            join=False,
            labels={"tilt_deg": "tilt, degrees"},
        ),
        "surface": _draw_angles(image.rows("surface"), "Echo of a border"),
        "anisotropy": _draw_angles(image.rows("anisotropy"), "Echo of fibres"),
        "arm_tilts": _draw_arm(image.rows("arm_median")),
        "strain": _draw_strain(image.rows("strain_estimate_rms")),
        "block_error": f"{image.worst('strain_block'):.2g}",
        "estimate": estimate[["artefact", "measured", "expected", "error_percent"]],
        "estimate_ms": f"{image.ms('strain_estimate_rms'):.0f}",
        "plain_ms": f"{image.ms('strain_none'):.2f}",
        "strain_ms": f"{image.ms('strain_image'):.2f}",
        "displacement_ms": f"{image.ms('strain_displacement'):.2f}",
        "flow_rate": draw_lines(
            image.rows("flow_rate"),
            "tilt_deg",
            "error_percent",
            "Error of the flow through a plane",
            panels="probe",
            lines="artefact",
            join=False,
            labels={"tilt_deg": "tilt, degrees", "error_percent": "error of the rate, %"},
        ),
        "flow_ms": f"{image.ms('flow_cost_off'):.2f}",
        "colour_ms": f"{image.ms('flow_cost_on'):.2f}",
        "run_time": pd.DataFrame(
            {
                "with": timed["artefact"].str.removeprefix("run_time_").str.replace("_", " "),
                "ms": timed["ms_median"],
                "times the slice": timed["ms_median"] / slice_ms,
            }
        ),
    }
    return Report(take_home, places, targets(table))


def _draw_attenuation(rows: pd.DataFrame) -> Figure:
    across = rows["artefact"].str.endswith("elevational").map({True: ", out of plane", False: ""})
    tilt = rows["tilt_deg"].map("{:g}°".format) + across
    return draw_lines(
        rows.assign(tilt=tilt),
        "depth_mm",
        "error_percent",
        "Loss in layers: error of the amplitude at the worst depths",
        panels="probe",
        lines="tilt",
        labels={"depth_mm": "depth, mm", "error_percent": "error, %"},
    )


def _draw_angles(rows: pd.DataFrame, title: str) -> Figure:
    melted = rows.melt(["artefact", "tilt_deg"], ["expected", "measured"], "of", "dB")
    return draw_lines(
        melted,
        "tilt_deg",
        "dB",
        f"{title}, closed form and image",
        panels="artefact",
        lines="of",
        labels={"tilt_deg": "tilt, degrees"},
    )


def _draw_arm(rows: pd.DataFrame) -> Figure | str:
    if rows.empty:
        return ""
    grid = {
        name: {f"{row.tilt_deg:g}°": row.images[name] for row in rows.itertuples()}
        for name in rows["images"].iloc[0]
    }
    return draw_image_grid(grid, "The arm at five tilts")


def _draw_strain(rows: pd.DataFrame) -> Figure | str:
    """The strain and its estimate in the ball, the press being 1 %."""
    if rows.empty:
        return ""
    images = rows["images"].iloc[0]
    grid = {"strain, %": {name: 100 * images[name] for name in ("strain", "estimate")}}
    title = "A stiff ball in a block pressed by 1 %: strain, and its estimate from two images"
    return draw_image_grid(grid, title, span=(-2.0, 0.0), colours="viridis", words="%")


IMAGE = Subject(
    "image",
    "Image: artefacts against closed forms",
    _pieces,
    _report,
    hidden=("images",),
    libraries=("numpy", "numba", "opencv-python-headless", "opencv-python"),
)
