"""Volume and tissue of a scene, made and kept before its nodes need them."""

from __future__ import annotations

from pathlib import Path

from us_sim.progress import late_progress
from us_sim.scene.building import volume_of
from us_sim.scene.scene import Scene


def prepare_scene(scene: Scene, path: Path | None = None, topic: str | None = None) -> None:
    """Make a phantom that is not in the cache yet, in view of the person who waits.

    The tissue of a case is made too, and kept in the case. Of a phantom that is there nothing is
    read, unless a path is played: its nodes do that, and notice damage.

    Args:
        scene: whose volume is made.
        path: that will be played.
        topic: of the body in it.

    Raises:
        UsSimError: the volume cannot be read, or no image along the path shows any of it.
    """
    phantom = scene.volume.phantom
    if path is None and phantom is not None:
        from us_sim.volume.phantom.phantom import is_phantom_kept

        if is_phantom_kept(phantom, scene.volume.seed, scene.volume.voxel_size):
            return
    volume = volume_of(scene, late_progress(f"making {scene.volume.name}"))
    if path is not None:
        from us_sim.scene.placement import check_path_in_volume

        check_path_in_volume(scene, path, volume, topic)
    if scene.volume.case is not None:
        from us_sim.scene.case_tissue import keep_tissue

        keep_tissue(scene, volume)
