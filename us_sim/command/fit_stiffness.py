"""The command `us-sim fit-stiffness`: a recorded press in, Young's moduli out."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from us_sim.command.options import add_setting_options, read_settings, scene_name
from us_sim.errors import BagError, SceneError, StiffnessError
from us_sim.settings.spelling import unknown
from us_sim.share import full_path
from us_sim.tissue.identification.settings import StiffnessSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from us_sim.scene.scene import Scene
    from us_sim.tissue.identification.press_record import PressRecord
    from us_sim.tissue.identification.stiffness import StiffnessFit, Tissue


_BEGIN = 0.3  # Stiffening with which a fit begins where the scene has none; a silicone's


def fit_stiffness_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene", nargs="?", help="scene file, name of an installed one, or folder of a case"
    )
    parser.add_argument("session", type=Path, help="recording with the probe's poses and wrenches")
    add_setting_options(parser, StiffnessSettings)
    parser.add_argument(
        "--case", metavar="NAME", help="case to make the scene from: its name or folder"
    )
    parser.add_argument(
        "--into-case", action="store_true", help="write the moduli into the case, too"
    )
    parser.add_argument(
        "--volume", type=Path, metavar="FILE", help="volume in place of the scene's"
    )
    parser.set_defaults(command=_fit)


def _fit(args: argparse.Namespace) -> int:
    from us_sim.command.stiffness_report import draw_fit, table, write_moduli
    from us_sim.progress import late_progress
    from us_sim.scene.reading import load_scene
    from us_sim.tissue.identification.stiffness import fit_stiffness, read_landmarks
    from us_sim.volume.cases.case import is_case

    settings = read_settings(args, StiffnessSettings)
    if args.scene is not None and is_case(args.scene):
        args.scene, args.case = None, args.scene
    name = scene_name(args)
    scene = load_scene(name, volume=args.volume)
    if args.into_case and not scene.volume.case:
        raise StiffnessError("--into-case: this scene is of no case; name one with --case")
    landmarks = read_landmarks(settings.landmarks) if settings.landmarks else None
    show = late_progress("fit-stiffness")
    show(0.0, "making the tissue")
    tissue, remarks = _tissue(scene, settings.stiffening, show)
    record, told = _record(args.session, tissue, settings)
    for remark in (*remarks, *told):
        print(remark)
    found = fit_stiffness(tissue, record, settings, landmarks, progress=show)
    print(table(found))
    draw_fit(settings.picture, found, f"{scene.name}: moduli from {args.session.name}")
    write_moduli(settings.out, found, _base(name, scene), scene.name)
    print(f"\n{settings.out}: a scene with these moduli; {settings.picture}: how they fit")
    if args.into_case and scene.volume.case:
        _write_into_case(scene.volume.case, args.session, found, settings)
    return 0


def _base(asked: str, scene: Scene) -> dict[str, str]:
    """The key and value by which a scene in another folder is based on this one."""
    from us_sim.scene.scene import CASE_PREFIX

    if scene.origin.startswith(CASE_PREFIX):
        return {"case": scene.origin.removeprefix(CASE_PREFIX)}
    is_file = os.path.exists(os.path.expanduser(asked))
    return {"based_on": str(full_path(scene.origin)) if is_file else asked}


def _write_into_case(
    case: str, session: Path, found: StiffnessFit, settings: StiffnessSettings
) -> None:
    """Write the fitted moduli into a case, with how they were found."""
    from us_sim.volume.cases.provenance import Source, Step
    from us_sim.volume.cases.writing import write_constants_into

    fitted = {}
    for name, interval in found.intervals.items():
        constant = "stiffening" if name in found.stiffenings else "young_modulus"
        fitted[name] = {constant: found.moduli[name], "factor": interval.factor}
    sources = (Source.of(session, "recorded press"),) if session.is_file() else ()
    said = {"confidence": settings.confidence, "kept": list(settings.keep), "moduli": fitted}
    step = Step("fitted stiffness to a press", said, {"poses": len(found.depths)}, sources)
    write_constants_into(case, found.constants, step)
    print(f"{case}: has these moduli now")


def _tissue(
    scene: Scene, stiffening: Sequence[str], progress: Callable[[float, str], None]
) -> tuple[Tissue, tuple[str, ...]]:
    """The tissue that is pressed, of which some structures' stiffening is unknown; and remarks."""
    from us_sim.scene.building import materials_of, tissue_model_of, volume_of
    from us_sim.tissue.identification.stiffness import Tissue
    from us_sim.tissue.solvers.fem_nonlinear import FemNonlinearSettings

    section = scene.tissue
    if section is None:
        raise SceneError(f"{scene.origin}: tissue: is missing, so that there is nothing to press")
    volume = volume_of(scene, progress)
    remarks: list[str] = []
    model = tissue_model_of(scene, volume, remarks.append)
    given = scene.solver_settings("fem_nonlinear") or FemNonlinearSettings()
    if given.contact != "frictionless" or given.viscosity > 0.0:
        remarks.append(
            "the fit leaves out the scene's friction and viscosity: press slowly and straight"
        )
    if section.solver != "fem_nonlinear":
        remarks.append(f"the moduli are those of fem_nonlinear, not of {section.solver}")
    materials = dict(section.materials)
    for name in stiffening:
        if name not in materials:
            raise StiffnessError(f"--stiffening: {unknown(name, materials)}")
    stiffenings = {f"stiffening of {name}": name for name in stiffening}

    def materials_for(moduli: Mapping[str, float]) -> Any:
        made = {name: replace(one, young_modulus=moduli[name]) for name, one in materials.items()}
        for key, name in stiffenings.items():
            made[name] = replace(made[name], stiffening=moduli[key])
        return materials_of(scene, made, model.mesh, volume)

    moduli = {name: material.young_modulus for name, material in materials.items()}
    begin = {key: materials[name].stiffening or _BEGIN for key, name in stiffenings.items()}
    return Tissue(model, materials_for, {**moduli, **begin}, stiffenings), tuple(remarks)


def _record(
    session: Path, tissue: Tissue, settings: StiffnessSettings
) -> tuple[PressRecord, tuple[str, ...]]:
    """The recorded press, and remarks on it."""
    from us_sim.recording.path import read_path
    from us_sim.recording.reader import read_bag
    from us_sim.recording.wrench import read_wrenches
    from us_sim.tissue.identification.press_model import PressedTissue
    from us_sim.tissue.identification.press_record import (
        find_delay,
        paired,
        stamped_alike,
        without_wrench,
    )

    bag = read_bag(session)
    path = read_path(session, bag.topic(settings.pose).name)
    if path.frame_id != "patient":
        raise BagError(
            f"{session}: {path.topic} is in frame '{path.frame_id}': name the probe's topic in "
            f"frame 'patient' with --pose, such as probe/pose"
        )
    poses = path.stamps, path.positions, path.orientations
    remarks = [path.note] if path.note else []
    try:
        bag.topic(settings.wrench)
    except BagError as error:
        if settings.landmarks is not None:
            return without_wrench(poses), (*remarks, f"{error}: landmarks alone are used")
        raise StiffnessError(f"{error}: name the force on the probe with --wrench") from error
    felt = read_wrenches(session, settings.wrench)
    if felt.frame_id != "probe":
        raise StiffnessError(
            f"{session}: {felt.topic} is in frame '{felt.frame_id}': turn the force into frame "
            f"'probe', about its origin, before it is recorded"
        )
    wrenches = felt.stamps, felt.wrenches
    late = settings.time_offset or 0.0
    if settings.time_offset is None and not stamped_alike(poses, wrenches):
        late = find_delay(
            poses, wrenches, PressedTissue(tissue.model).clearance, settings.largest_offset
        )
        remarks.append(
            f"the wrenches are taken to be {1e3 * late:+.0f} ms late, by loading and unloading"
        )
    record = paired(poses, wrenches, tolerance=settings.tolerance, time_offset=late)
    if record.unpaired:
        remarks.append(
            f"{record.unpaired} of {len(path)} poses have no wrench within "
            f"{1e3 * settings.tolerance:g} ms of them and are left out"
        )
    return record, tuple(remarks)
