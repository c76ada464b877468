"""What a segmentation came to, in lines for a person and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from us_sim.volume.surfaces.structure_surface import StructureSurface

_HEADING = ("structure", "volume", "triangles", "area", "parts", "handles", "volume kept", "moved")


def summary(where: Path, made: Sequence[StructureSurface], remarks: Sequence[str]) -> str:
    """A line for each structure, and what should be known."""
    rows = [_HEADING, *(_cells(one) for one in made)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADING))]
    lines = [
        "  ".join(
            cell.ljust(width) if not column else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    return "\n".join([*lines, *(f"note: {remark}" for remark in remarks), f"written to {where}"])


def write_report(
    file: Path, picture: str, made: Sequence[StructureSurface], remarks: Sequence[str]
) -> None:
    """The same as Markdown, with the picture."""
    lines = ["# Segmentation", "", f"![slices with outlines, and surfaces]({picture})", ""]
    lines += [f"| {' | '.join(_HEADING)} |", "|" + " --- |" * len(_HEADING)]
    lines += [f"| {' | '.join(_cells(one))} |" for one in made]
    lines += [
        "",
        "Volume is that of the labelled voxels; volume kept is what the surface encloses of it. "
        "Handles count how often a surface has a hole right through. Moved is the largest distance "
        "by which fewer triangles moved the surface.",
        "",
        *(f"- {remark}" for remark in remarks),
    ]
    file.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _cells(one: StructureSurface) -> tuple[str, ...]:
    surface = one.surface
    return (
        one.name,
        f"{one.voxels_volume * 1e6:.3f} ml",
        str(len(surface.triangles)),
        f"{surface.area * 1e4:.2f} cm²",
        str(surface.parts),
        str(surface.genus),
        f"{100 * one.volume_kept:.2f} %",
        f"{one.moved * 1e3:.3f} mm",
    )
