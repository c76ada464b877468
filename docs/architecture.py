"""Draws docs/architecture.png: the rooms of the package, and who imports whom, read from the code.

python docs/architecture.py
"""

from __future__ import annotations

import ast
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

PACKAGE = Path(__file__).resolve().parents[1] / "us_sim"
PICTURE = Path(__file__).with_suffix(".png")

LAYERS = (
    ("compose and measure", (("command",), ("run", "evaluation", "to_rerun"), ("demo", "", ""))),
    ("nodes", (("nodes",),)),
    (
        "the domain, without ROS",
        (
            ("scene", "viewer"),
            ("skin", "tissue", "slicing", "tracking"),
            ("", "", "volume", "recording"),
            ("geometry",),
            ("settings",),
        ),
    ),
)
"""Layers from the top, each of rows of rooms ("" is a gap); no arrow leads to a layer above."""

BESIDE = "standalone"
"""The room that stands beside the others: it imports none, and the nodes alone know of it."""
COLOURS = ("#dce9f7", "#fbe6cf", "#e0f0dc")


def imports_of(file: Path) -> set[str]:
    """The modules of this package that a file imports, also in functions; not those for types."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            node.body = []
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name.startswith("us_sim.")}


def rooms() -> dict[str, str]:
    """What each room says of itself in its ``__init__.py``, by its name."""
    return {
        file.parent.name: (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "")
        for file in sorted(PACKAGE.glob("*/__init__.py"))
    }


def arrows() -> set[tuple[str, str]]:
    """Which room imports which, by their names."""
    names, found = set(rooms()), set()
    for room in names:
        for file in (PACKAGE / room).rglob("*.py"):
            others = {module.split(".")[1] for module in imports_of(file)}
            found |= {(room, other) for other in others & names - {room}}
    return found


def reached(start: str, pairs: set[tuple[str, str]]) -> set[str]:
    """The rooms to which arrows lead from one, over any number of others."""
    found: set[str] = set()
    waiting = [start]
    while waiting:
        room = waiting.pop()
        new = {end for begin, end in pairs if begin == room} - found
        found |= new
        waiting += new
    return found


def drawn(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Those arrows that are not implied by a way over other rooms."""
    return {
        (start, end)
        for start, end in pairs
        if not any(
            end in reached(between, pairs) for begin, between in pairs if begin == start != between
        )
    }


def described() -> str:
    """The arrows of the picture in words; the picture keeps them, so that a test can compare."""
    return ", ".join(f"{start} -> {end}" for start, end in sorted(drawn(arrows())))


def places() -> dict[str, tuple[float, float]]:
    """The middle of each room in the picture: x, and y from the bottom."""
    y, found = 0.0, {}
    for _, rows in reversed(LAYERS):
        for row in reversed(rows):
            for column, room in enumerate(row):
                if room:
                    found[room] = (2.8 * (column - (len(row) - 1) / 2), y)
            y += 1.25
        y += 0.45
    found[BESIDE] = (8.0, found["nodes"][1])
    return found


def draw() -> None:
    """Write the picture."""
    at = places()
    figure, axes = plt.subplots(figsize=(11, 9))
    for (name, rows), colour in zip(LAYERS, COLOURS, strict=True):
        high = max(at[room][1] for row in rows for room in row if room) + 0.6
        low = min(at[room][1] for row in rows for room in row if room) - 0.6
        layer = FancyBboxPatch((-6.4, low), 12.4, high - low, boxstyle="round,pad=0.05", lw=0)
        layer.set_facecolor(colour)
        axes.add_patch(layer)
        axes.text(-6.3, high - 0.05, name, va="top", fontsize=12, style="italic", color="#444444")
    boxes = {}
    for room, (x, y) in at.items():
        boxes[room] = FancyBboxPatch((x - 1, y - 0.28), 2, 0.56, boxstyle="round,pad=0.05")
        boxes[room].set(facecolor="white", edgecolor="#333333", zorder=3)
        axes.add_patch(boxes[room])
        axes.text(x, y, room, ha="center", va="center", fontsize=13, zorder=4)
    for start, end in drawn(arrows()):
        arrow = FancyArrowPatch(
            at[start], at[end], patchA=boxes[start], patchB=boxes[end], arrowstyle="-|>"
        )
        arrow.set(mutation_scale=16, color="#555555", linewidth=1.4, zorder=2)
        axes.add_patch(arrow)
    axes.set_xlim(-6.6, 9.2)
    axes.set_ylim(-0.8, max(y for _, y in at.values()) + 0.8)
    axes.axis("off")
    metadata = {"Software": None, "Description": described()}
    figure.savefig(PICTURE, dpi=90, bbox_inches="tight", metadata=metadata)
    plt.close(figure)


if __name__ == "__main__":
    draw()
