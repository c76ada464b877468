"""The command `us-sim fit-stiffness`: a recorded press in, Young's moduli out."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml

from us_sim.command.options import (
    add_scene_options,
    add_setting_options,
    read_scene_name,
    read_settings,
)
from us_sim.errors import BagError, SceneError
from us_sim.settings.spelling import align_columns
from us_sim.share import full_path
from us_sim.tissue.stiffness_fit import StiffnessSettings

if TYPE_CHECKING:
    from us_sim.scene.scene import Scene
    from us_sim.tissue.elasticity.materials import TissueMaterials
    from us_sim.tissue.stiffness_fit import RecordedPress, StiffnessFit


def fit_stiffness_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim fit-stiffness`."""
    add_scene_options(parser)
    parser.add_argument("session", type=Path, help="recording with the probe's poses and wrenches")
    add_setting_options(parser, StiffnessSettings)
    parser.set_defaults(command=_fit)


def _fit(args: argparse.Namespace) -> int:
    from us_sim.progress import late_progress
    from us_sim.scene.building import build_materials, build_tissue_model, load_volume
    from us_sim.scene.reading import load_scene
    from us_sim.tissue.stiffness_fit import fit_stiffness

    settings = read_settings(args, StiffnessSettings)
    name = read_scene_name(args)
    scene = load_scene(name, volume=args.volume)
    section = scene.tissue
    if section is None:
        raise SceneError(f"{scene.origin}: tissue: is missing, so that there is nothing to press")
    press = _read_press(args.session, settings)
    volume = load_volume(scene)
    model = build_tissue_model(scene, volume, print)

    def make_materials(moduli: Mapping[str, float]) -> TissueMaterials:
        given = section.materials
        made = {name: replace(given[name], young_modulus=moduli[name]) for name in given}
        return build_materials(scene, made, model.mesh, volume)

    moduli = {name: material.young_modulus for name, material in section.materials.items()}
    show = late_progress("fit-stiffness")
    found = fit_stiffness(model, make_materials, moduli, press, settings, show)
    print(_format_table(found))
    _write_scene(settings.out, found, _find_base(name, scene), scene.name)
    _draw(settings.out.with_suffix(".png"), found)
    print(f"{settings.out}: a scene with these moduli; its .png: how they fit")
    return 0


def _read_press(session: Path, settings: StiffnessSettings) -> RecordedPress:
    from us_sim.recording.lerobot_writer import WRENCH_PARTS
    from us_sim.recording.path import read_path
    from us_sim.recording.reader import read_bag
    from us_sim.run.session_tables import read_wrenches
    from us_sim.tissue.stiffness_fit import pair_press

    bag = read_bag(session)
    path = read_path(session, bag.find_topic(settings.pose).name)
    wrench_frame, table = read_wrenches(bag, settings.wrench)
    for topic, frame, expected, option in (
        (path.topic, path.frame_id, "patient", "--pose"),
        (settings.wrench, wrench_frame, "probe", "--wrench"),
    ):
        if frame != expected:
            raise BagError(
                f"{session}: {topic} is in frame '{frame}': name a topic in frame '{expected}' "
                f"with {option}"
            )
    wrenches = table[[*WRENCH_PARTS]].to_numpy()
    return pair_press(path.stamps, path.poses, table["stamp"].to_numpy(), wrenches, settings)


def _format_table(found: StiffnessFit) -> str:
    """Format the structures with their moduli and intervals, and the residuals."""
    rows = [("structure", "E (kPa)", "95 % interval (kPa)")]
    for name, modulus in found.moduli.items():
        factor = found.factors.get(name)
        limits = (
            f"{modulus / factor / 1e3:.4g} to {modulus * factor / 1e3:.4g}" if factor else "kept"
        )
        rows.append((name, f"{modulus / 1e3:.4g}", limits))
    force, torque = (np.sqrt((found.left[:, k : k + 3] ** 2).mean()) for k in (0, 3))
    left = (
        f"left over (RMS): {force:.3g} N, {1e3 * torque:.3g} mN m at {len(found.depths)} poses "
        f"down to {1e3 * found.depths.max():.1f} mm"
    )
    return "\n".join([*align_columns(rows), left])


def _find_base(name: str, scene: Scene) -> dict[str, str]:
    """Return the key and value by which a scene in another folder is based on this one."""
    from us_sim.scene.scene import CASE_PREFIX

    if scene.origin.startswith(CASE_PREFIX):
        return {"case": scene.origin.removeprefix(CASE_PREFIX)}
    is_file = os.path.exists(os.path.expanduser(name))
    return {"based_on": str(full_path(scene.origin)) if is_file else name}


def _write_scene(file: Path, found: StiffnessFit, base: Mapping[str, str], name: str) -> None:
    materials = {
        structure: {"young_modulus": float(f"{found.moduli[structure]:.6g}")}
        for structure in found.factors
    }
    document = {"name": f"{name}_fitted", **base, "tissue": {"materials": materials}}
    remark = "".join(f"# {line}".rstrip() + "\n" for line in _format_table(found).splitlines())
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    file.write_text(f"# Fitted to a recorded press by `us-sim fit-stiffness`.\n{remark}{text}")


def _draw(file: Path, found: StiffnessFit) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    measured = found.press.wrenches - found.offset
    panels = zip(figure.subplots(2), (0, 3), ("force (N)", "torque (N m)"), strict=True)
    for panel, first, label in panels:
        for k, axis in enumerate("xyz", first):
            (line,) = panel.plot(found.press.times, measured[:, k], ".", label=axis)
            modelled = measured[:, k] - found.left[:, k]
            panel.plot(found.press.times, modelled, color=line.get_color())
        panel.set(xlabel="time (s)", ylabel=label, title="measured (dots) and modelled (lines)")
        panel.legend()
    figure.savefig(file)
