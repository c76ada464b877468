"""The commands about volumes and cases: `import`, `reconstruct`, `segment`, `cases`."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from us_sim.command.options import add_setting_options, read_settings
from us_sim.errors import UsSimError
from us_sim.progress import late_progress


def import_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim import`."""
    from us_sim.volume.deidentification.settings import ImportSettings

    parser.add_argument(
        "files",
        nargs="+",
        type=Path,
        help="DICOM files of one series, or a folder of them; or an MHA, NRRD or NIfTI volume",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="CASE|FILE",
        help="new folder of a case, or volume (.nrrd, .mha, .nii, .nii.gz)",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="write the first image as it is, with boxes around what is kept, as a PNG",
    )
    add_setting_options(parser, ImportSettings)
    parser.set_defaults(command=_import)


def _import(args: argparse.Namespace) -> int:
    from us_sim.volume.deidentification.importing import plan_import
    from us_sim.volume.deidentification.settings import ImportSettings

    if args.out is None and args.picture is None:
        raise UsSimError(
            "say where to with --out CASE|FILE, or --picture to see what would be done"
        )
    found = plan_import(args.files, args.out, read_settings(args, ImportSettings))
    if args.picture is not None:  # before a refusal, as it shows the reason
        found.draw(args.picture)
        print(f"{args.picture}: may show a name")
    if args.out is not None:
        found.write(late_progress("import"))
    print(f"{args.out or args.picture}: {found.summary}")
    return 0


def reconstruct_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim reconstruct`."""
    from us_sim.command.reconstruct_sweep import SweepSettings
    from us_sim.volume.reconstruction.settings import Compounding, ImagePart

    for settings in (SweepSettings, Compounding, ImagePart):
        add_setting_options(parser, settings)
    parser.add_argument(
        "--undo-pressure",
        metavar="SCENE",
        help="place the images where the tissue of this scene lies while no probe presses it; the "
        "sweep's reference frame is the scene's patient",
    )
    parser.set_defaults(command=_reconstruct)


def _reconstruct(args: argparse.Namespace) -> int:
    from us_sim.command.reconstruct_sweep import SweepSettings, reconstruct_sweep
    from us_sim.volume.reconstruction.settings import Compounding, ImagePart

    settings = read_settings(args, SweepSettings)
    compounding, part = read_settings(args, Compounding), read_settings(args, ImagePart)
    rest_of = None
    if args.undo_pressure is not None:
        from us_sim.scene.placement import build_rest_placement
        from us_sim.scene.reading import load_scene

        rest_of = partial(build_rest_placement, load_scene(args.undo_pressure))

    progress = late_progress(f"reconstruct {Path(settings.sweep).name}")
    print(reconstruct_sweep(settings, compounding, part, rest_of=rest_of, progress=progress))
    return 0


def segment_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim segment`."""
    from us_sim.volume.segmentation.settings import SegmentRequest

    add_setting_options(parser, SegmentRequest)
    parser.set_defaults(command=_segment)


def _segment(args: argparse.Namespace) -> int:
    from us_sim.command.segment_case import run_segmentation
    from us_sim.volume.segmentation.settings import SegmentRequest

    print(run_segmentation(read_settings(args, SegmentRequest), late_progress("segment")))
    return 0


def cases_options(cases: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim cases`."""
    cases.add_argument(
        "folders",
        nargs="*",
        type=Path,
        metavar="DIR",
        help="folder of cases, or a case; default: those in US_SIM_CASES, or in the user's data "
        "folder",
    )
    cases.set_defaults(command=_cases)


def _cases(args: argparse.Namespace) -> int:
    from us_sim.volume.cases.case import find_cases, format_cases, list_case, list_case_roots

    roots = args.folders or [root for root in list_case_roots() if root.is_dir()]
    folders = [folder for root in roots for folder in find_cases(root)]
    if not folders:
        where = ", ".join(map(str, args.folders or list_case_roots()))
        print(f"no case in {where}; `us-sim import` and `us-sim reconstruct` make one")
        return 0
    rows = [list_case(folder) for folder in folders]
    print(format_cases(rows))
    return 1 if any(row.problem for row in rows) else 0
