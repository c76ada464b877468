"""Whether the files that a scene names can be read, found out without running it.

>>> from us_sim.scene.reading import parse_scene
>>> from us_sim.scene.readable_files import check_files
>>> scene = parse_scene({"name": "bare", "volume": {"phantom": "upper_arm"},
...                      "probe": {"aperture": "40 mm", "depth": "30 mm", "image": [400, 300]}})
>>> check_files(scene)
[]
"""

from __future__ import annotations

from pathlib import Path

from us_sim.scene.building import path_of
from us_sim.scene.scene import Scene, TissueSettings
from us_sim.scene.tracker_building import camera_body_of, source_settings, tracking_of


def check_files(scene: Scene) -> list[str]:
    """Read what files the scene names, of its volume only the header; the keys that name them.

    Raises:
        UsSimError: one cannot be used, and why.
    """
    checked = []
    if scene.volume.file:
        from us_sim.volume.files.readers import read_placement

        read_placement(Path(scene.volume.file))
        checked.append("volume.file (its header)")
    if scene.volume.case:
        from us_sim.volume.cases.case import read_case

        case = read_case(scene.volume.case)
        case.placement()
        if case.has_labels:
            case.check_grids()
        checked.append("volume.case (its headers)")
    if scene.tissue is not None and scene.tissue.mesh.file:
        checked.append(f"tissue.mesh.file ({'; '.join(_mesh_remarks(scene.tissue))})")
    surfaces = {f"structures.{name}.file": s.file for name, s in scene.structures.items()}
    if scene.skin is not None:
        surfaces["skin.file"] = scene.skin.file
    for key, file in surfaces.items():
        if file:
            from us_sim.skin.surface import read_surface

            read_surface(file)
            checked.append(key)
    tracker = scene.tracker
    tracking_of(scene)
    checked += [
        f"tracker.{key}"
        for key in ("registration", "calibration")
        if isinstance(getattr(tracker, key), str)
    ]
    if tracker.source.name == "camera" and source_settings(scene, "camera").body:
        camera_body_of(scene)
        checked.append("tracker.camera.body")
    if tracker.source.name == "path" and tracker.file:
        path_of(scene, Path(tracker.file))
        checked.append("tracker.file")
    if scene.path:
        from us_sim.recording.path import read_path

        read_path(Path(scene.path), option="--topic")
        checked.append("path")
    return checked


def _mesh_remarks(tissue: TissueSettings) -> list[str]:
    """What there is to say about the mesh of a file, as far as it says so without the volume."""
    from us_sim.tissue.mesh.file import read_mesh
    from us_sim.tissue.model import FACES, face_nodes, held_remark

    given = tissue.mesh
    mesh, remarks = read_mesh(Path(given.file or ""), given.unit, given.pose.pose)
    names = [name for name in tissue.fixed if name in FACES]
    held = [held_remark(name, face_nodes(mesh, name, given.margin), mesh) for name in names]
    return [f"{len(mesh.nodes)} nodes", *remarks, *(said for said in held if said)]
