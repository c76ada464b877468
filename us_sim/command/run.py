"""The command `us-sim run`."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from us_sim.command.scene_options import (
    add_network_option,
    add_path_option,
    add_scene_options,
    add_supervision_options,
    add_view_option,
    node_parameters,
    scene_name,
    supervision,
    viewed,
)
from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class RunSettings(Settings):
    """What becomes of a run."""

    record: Path | None = setting(description="record the session to this MCAP", default=None)
    duration: float | None = setting(Quantity("time", 1e-3, 1e7), "end after so long", default=None)

    def check(self) -> None:
        """Refuse a recording that cannot be made, before anything is started."""
        if self.record is not None and self.record.suffix != ".mcap":
            raise self.refused("record", f"{self.record}: must be a file that ends in .mcap")
        if self.record is not None and self.record.exists():
            raise self.refused("record", f"{self.record}: exists already; choose another name")


def add_run(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "run", help="run the nodes of a scene until Ctrl-C", add_options=_add_options
    )


def _add_options(run: argparse.ArgumentParser) -> None:
    run.add_argument("scene", nargs="?", help="scene file, or name of an installed one")
    add_setting_options(run, RunSettings)
    add_supervision_options(run)
    add_path_option(run, "play this bag's probe path")
    run.add_argument("--dry-run", action="store_true", help="say what would run, and why")
    add_scene_options(run)
    add_view_option(run)
    add_network_option(run)
    run.set_defaults(command=_run)


def _run(args: argparse.Namespace) -> int:
    from us_sim.run.forking import ForkServer

    asked = read_settings(args, RunSettings)
    if args.dry_run:
        return _dry_run(args, asked)
    parameters = node_parameters(args.param)
    with ForkServer() as forks:  # which imports what the nodes need while this process does
        from us_sim.run.live import run
        from us_sim.scene.reading import load_scene

        return run(
            load_scene(scene_name(args), volume=args.volume),
            parameters,
            record=asked.record,
            path=args.path,
            topic=args.topic,
            duration=asked.duration,
            network=args.network,
            supervision=supervision(args),
            view=viewed(args),
            forks=forks,
        )


def _dry_run(args: argparse.Namespace, asked: RunSettings) -> int:
    """Say what would run, having looked into the files that it names."""
    from us_sim.run.live import dry_run
    from us_sim.scene.reading import check_files, load_scene

    scene = load_scene(scene_name(args), volume=args.volume)
    checked = check_files(scene)
    path = args.path or (Path(scene.path) if scene.path else None)
    if path is not None and not scene.volume.phantom:
        from us_sim.scene.building import volume_of
        from us_sim.scene.placement import check_path_in_volume

        check_path_in_volume(scene, path, volume_of(scene), args.topic if args.path else None)
    parameters = node_parameters(args.param)
    asked_of = {"record": asked.record, "path": args.path, "topic": args.topic}
    print(dry_run(scene, parameters, **asked_of, view=viewed(args)))
    if checked:
        print(f"readable  {', '.join(checked)}")
    return 0
