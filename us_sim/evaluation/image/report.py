"""`us-sim evaluate image`: sound in images, against closed forms, and what it costs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from us_sim.evaluation.figures import draw_image_grid, draw_lines
from us_sim.evaluation.image.acoustics import (
    attenuation_rows,
    fibre_rows,
    shadow_rows,
    surface_rows,
)
from us_sim.evaluation.image.arm import arm_images, run_time_rows
from us_sim.evaluation.subject import Piece, Report, Subject, Target

ARTEFACTS: Mapping[str, Callable[[bool], Iterable[Mapping[str, Any]]]] = {
    "attenuation": attenuation_rows,
    "shadow_edge": shadow_rows,
    "surface": surface_rows,
    "anisotropy": fibre_rows,
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
        off = table["measured"] - table["expected"]
        self.table = table.assign(off=off)

    def rows(self, artefact: str) -> pd.DataFrame:
        """Those whose artefact begins so."""
        return self.table[self.table["artefact"].str.startswith(artefact)]

    def worst(self, artefact: str, column: str = "off") -> float:
        """The greatest of an error."""
        return float(self.rows(artefact)[column].abs().max())

    def ms(self, kind: str) -> float:
        """Median processor time of an image."""
        return float(self.rows(f"run_time_{kind}")["measured"].max())


def targets(table: pd.DataFrame) -> list[Target]:
    """Limits against the measured numbers."""
    image = _Table(table)
    loss = image.worst("attenuation", "error_percent")
    limits: Sequence[tuple[str, float, float, str]] = (
        ("loss in layers, tilted up to 40°: amplitude, worst depth", 1.0, loss, "%"),
        *(
            (
                f"shadow of bone, {state}: pixels from its geometric edge, worst",
                1.0,
                image.worst(f"shadow_edge_{state}"),
                "",
            )
            for state in ("rest", "pressed", "slid")
        ),
        ("echo of a border by its angle: off by most", 1.0, image.worst("surface"), "dB"),
        ("echo of fibres by their angle: likewise", 0.1, image.worst("anisotropy"), "dB"),
        ("image of 512 × 512 with all acoustics, one core", 1.5, image.ms("all"), "ms"),
        ("as many times what the slice takes", 1.67, image.ms("all") / image.ms("slice"), ""),
        ("strain, likewise", 2.22, image.ms("strain") / image.ms("slice"), ""),
    )
    return [Target.at_most(*limit) for limit in limits]


def _report(table: pd.DataFrame) -> Report:
    image = _Table(table)
    timed = image.rows("run_time")
    take_home = [
        f"Loss through layers is {image.worst('attenuation', 'error_percent'):.2g} % off in "
        f"amplitude at worst.",
        f"A shadow's edge is {image.worst('shadow_edge'):.2g} pixels off, at rest and pressed.",
        f"Echoes of borders and fibres follow the angle of the beam within "
        f"{image.worst('surface'):.2g} and {image.worst('anisotropy'):.1g} dB.",
        f"An image of 512 × 512 takes {image.ms('slice'):.2f} ms of a core, with strain "
        f"{image.ms('strain'):.2f} ms, with all acoustics {image.ms('all'):.2f} ms.",
    ]
    places = {
        "attenuation": _draw_attenuation(image.rows("attenuation")),
        "shadow": draw_lines(
            image.rows("shadow_edge"),
            "tilt_deg",
            "off",
            "A shadow's edge: pixels from the geometric one",
            panels="probe",
            lines="artefact",
            join=False,
            labels={"tilt_deg": "tilt, degrees", "off": "pixels"},
        ),
        "angles": _draw_angles(pd.concat([image.rows("surface"), image.rows("anisotropy")])),
        "arm_tilts": draw_image_grid(arm_images(), "The arm at five tilts"),
        "run_time": pd.DataFrame(
            {
                "with": timed["artefact"].str.removeprefix("run_time_").str.replace("_", " "),
                "ms": timed["measured"],
                "times the slice": timed["measured"] / image.ms("slice"),
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


def _draw_angles(rows: pd.DataFrame) -> Figure:
    melted = rows.melt(["artefact", "tilt_deg"], ["expected", "measured"], "of", "dB")
    return draw_lines(
        melted,
        "tilt_deg",
        "dB",
        "Echoes of a border and of fibres, closed form and image",
        panels="artefact",
        lines="of",
        share_y=False,
        labels={"tilt_deg": "tilt, degrees"},
    )


IMAGE = Subject(
    "image",
    "Image: sound against closed forms",
    _pieces,
    _report,
    libraries=("numpy", "numba", "opencv-python-headless", "opencv-python"),
)
