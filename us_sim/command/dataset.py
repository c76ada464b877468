"""The command `us-sim dataset`: episodes of scenes with images and every truth."""

from __future__ import annotations

import argparse

from us_sim.command.options import add_setting_options, read_scene_keys, read_settings
from us_sim.errors import EpisodeError


def dataset_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim dataset`; raise EpisodeError if gymnasium is missing."""
    try:
        from us_sim.environment.dataset import DatasetSettings
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "gymnasium":
            raise
        raise EpisodeError(
            "data sets need the package gymnasium: pip install 'us_sim[environment]'"
        ) from error
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="file, name, or case:NAME")
    parser.add_argument(
        "--out",
        metavar="DIR",
        required=True,
        help="folder, or an address of fsspec as s3://BUCKET/FOLDER (extra ray); one with part of "
        "the same data set is gone on with",
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="have the episodes made on this Ray cluster in place of processes; local: on one that "
        "is started on this machine (extra ray)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="set a key of the scenes, as tissue.solver=fem; may be given again",
    )
    add_setting_options(parser, DatasetSettings, ("episodes", "task", "workers", "seed", "format"))
    parser.set_defaults(command=_dataset)


def _dataset(args: argparse.Namespace) -> int:
    from us_sim.environment.dataset import DatasetSettings, make_dataset

    settings = read_settings(args, DatasetSettings)
    return make_dataset(args.scenes, settings, read_scene_keys(args.set))
