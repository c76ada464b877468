"""Read the structure of the package from its code, and draw it: docs/architecture.png.

python docs/architecture.py

The tests of the structure read it with the same functions.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "us_sim"

LAYERS = (
    (
        "compose and measure",
        (("command",), ("evaluation", "run"), ("viewer",)),
    ),
    ("nodes", (("nodes",),)),
    (
        "the domain, without ROS",
        (
            ("", "environment", "scene", "scoring"),
            ("skin", "tissue", "slicing", "tracking"),
            ("", "", "volume", "recording"),
            ("geometry",),
            ("settings",),
        ),
    ),
)
"""Layers from the top, each of rows of rooms ("" is a gap); no arrow leads to a layer above."""

FILES = {
    ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted(PACKAGE.rglob("*.py"))
}
"""The file of each module, by its dotted name."""


@functools.cache
def tree(module: str) -> ast.Module:
    """The syntax tree of a module."""
    return ast.parse(FILES[module].read_text(encoding="utf-8"))


@functools.cache
def imports(module: str, *, types: bool = False) -> frozenset[str]:
    """Modules of any package that a module imports, also within functions.

    Args:
        types: also those imported for types alone.
    """

    def within(nodes: list[ast.stmt]) -> Iterator[str]:
        for node in nodes:
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                folder = FILES[module].relative_to(PACKAGE.parent).parts[: -node.level or None]
                parts = [*(folder if node.level else ()), *filter(None, [node.module])]
                origin = ".".join(parts)
                for alias in node.names:
                    inner = f"{origin}.{alias.name}"
                    yield inner if inner in FILES else origin
            elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                yield from within([*node.orelse, *(node.body if types else [])])
            else:
                for block in ("body", "orelse", "handlers", "finalbody", "cases"):
                    yield from within(getattr(node, block, []))

    return frozenset(within(tree(module).body))


def room_of(module: str) -> str:
    """The room that a module of this package is in; its own name where it stands at the top."""
    return module.split(".")[1] if "." in module else ""


def rooms() -> dict[str, str]:
    """The description of each room in its ``__init__.py``, by its name."""
    return {
        file.parent.name: ast.get_docstring(tree(f"us_sim.{file.parent.name}")) or ""
        for file in sorted(PACKAGE.glob("*/__init__.py"))
    }


def arrows() -> set[tuple[str, str]]:
    """Pairs of rooms, of which the first imports the second."""
    names = set(rooms())
    pairs = {
        (room_of(module), room_of(imported))
        for module in FILES
        for imported in imports(module)
        if imported.startswith("us_sim.")
    }
    return {(start, end) for start, end in pairs if start != end and {start, end} <= names}


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


def not_implied(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Those arrows that no way over other rooms implies."""
    return {
        (start, end)
        for start, end in pairs
        if not any(
            end in reached(between, pairs) for begin, between in pairs if begin == start != between
        )
    }


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
    return found


def draw() -> None:
    """Write the picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

    at = places()
    figure, axes = plt.subplots(figsize=(9, 9))
    for (name, rows), colour in zip(LAYERS, ("#dce9f7", "#fbe6cf", "#e0f0dc"), strict=True):
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
    for start, end in not_implied(arrows()):
        arrow = FancyArrowPatch(
            at[start], at[end], patchA=boxes[start], patchB=boxes[end], arrowstyle="-|>"
        )
        arrow.set(mutation_scale=16, color="#555555", linewidth=1.4, zorder=2)
        axes.add_patch(arrow)
    axes.set_xlim(-6.6, 6.2)
    axes.set_ylim(-0.8, max(y for _, y in at.values()) + 0.8)
    axes.axis("off")
    picture = Path(__file__).with_suffix(".png")
    figure.savefig(picture, dpi=90, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    draw()
