"""The command `us-sim press`: how deep a probe pushes with a force, as CSV and picture."""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from us_sim.command.options import (
    add_scene_options,
    add_setting_options,
    read_scene_name,
    read_settings,
)
from us_sim.errors import SceneError, SolverError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

if TYPE_CHECKING:
    from us_sim.tissue.elasticity.materials import LabelFractions
    from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
    from us_sim.tissue.press import Press

_MOSTLY = 0.5  # least part of a label in the tetrahedra that count for its greatest strain


@dataclass(frozen=True)
class PressSettings(Settings):
    """A press: each field is an option of ``us-sim press``."""

    error = SolverError

    force: float = setting(Quantity("force", 1e-6, 1e4), "with which the probe pushes", default=5.0)
    at: tuple[float, float] = setting(
        Quantity("length", -1.0, 1.0), "place of the probe: x, y in `patient`", default=(0.0, 0.0)
    )
    step: float = setting(
        Quantity("length", 1e-5, 0.1), "between the poses on the way", default=1e-3
    )
    deepest: float = setting(Quantity("length", 1e-4, 1.0), "that it may come", default=0.1)
    out: Path = setting(
        description="CSV to write; a picture goes beside it", default=Path("press.csv")
    )

    def check(self) -> None:
        """Refuse files that exist, before the work."""
        self.require_new_file("out", ".csv", picture=True)


def press_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim press`."""
    add_scene_options(parser)
    parser.add_argument("--solver", help="method in place of the scene's")
    add_setting_options(parser, PressSettings)
    parser.set_defaults(command=_press)


def _press(args: argparse.Namespace) -> int:
    from us_sim.geometry.pose import Pose
    from us_sim.progress import late_progress
    from us_sim.scene.building import build_tissue_model, compute_label_fractions, load_volume
    from us_sim.scene.reading import load_scene
    from us_sim.tissue.press import press_to_force
    from us_sim.tissue.solvers.solver import create_solver

    settings = read_settings(args, PressSettings)
    scene = load_scene(read_scene_name(args), volume=args.volume)
    section = scene.tissue
    if section is None:
        raise SceneError(f"{scene.origin}: tissue: is missing, so that there is nothing to press")
    volume = load_volume(scene)
    model = build_tissue_model(scene, volume, print)
    name = args.solver or section.solver
    chosen: Any = section.settings.get(name)
    solver = create_solver(name, model, chosen)
    start = Pose(np.array([*settings.at, 0.0]))
    show = late_progress(f"pressing with {settings.force:g} N")
    curve = press_to_force(
        solver, settings.force, start, step=settings.step, deepest=settings.deepest, progress=show
    )
    show(1.0, f"{1e3 * curve[-1].depth:.2f} mm deep")
    fractions, names = compute_label_fractions(model.mesh, volume), volume.label_names
    table = _make_table(model.mesh, curve, fractions, {0: "tissue"} | dict(names))
    with settings.out.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([list(table), *zip(*table.values(), strict=True)])
    _draw(settings.out.with_suffix(".png"), table)
    last = curve[-1]
    print(f"{last.force:.3g} N {1e3 * last.depth:.2f} mm deep, by {name}: {settings.out}, .png")
    return 0


def _make_table(
    mesh: TetrahedralMesh,
    curve: list[Press],
    fractions: LabelFractions | None,
    names: dict[int, str],
) -> dict[str, list[float]]:
    """Return columns by name: force, depth, and for each label strains along the probe's axis.

    The strains, in percent, are the mean by volume and that of the most compressed tetrahedron.
    """
    from us_sim.tissue.press import strains_along

    table: dict[str, list[float]] = {
        "force_n": [round(press.force, 5) for press in curve],
        "depth_mm": [round(1e3 * press.depth, 5) for press in curve],
    }
    parts = {names[0]: np.ones(len(mesh.tetrahedra))}
    if fractions is not None:
        parts = {names[int(label)]: fractions.for_label(int(label)) for label in fractions.labels}
    strains = [
        100 * strains_along(mesh, press.deformation.nodes, press.pose.rotation[:, 2])
        for press in curve
    ]
    for name, part in parts.items():
        weights = mesh.volumes * part
        mostly = part >= min(_MOSTLY, float(part.max()))
        table[f"mean_strain_{name}_percent"] = [
            round(float(np.average(strain, weights=weights)), 4) for strain in strains
        ]
        table[f"most_strain_{name}_percent"] = [
            round(float(strain[mostly].min()), 4) for strain in strains
        ]
    return table


def _draw(file: Path, table: dict[str, list[float]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(table["depth_mm"], table["force_n"], "k.-")
    left.set(xlabel="depth (mm)", ylabel="force (N)")
    for name, values in table.items():
        if name.startswith("mean_strain_"):
            label = name.removeprefix("mean_strain_").removesuffix("_percent")
            right.plot(table["force_n"], values, ".-", label=label)
    right.set(xlabel="force (N)", ylabel="mean strain along the probe (%)")
    right.legend()
    figure.savefig(file)
