"""Tissues that a hand presses, and its motions on each.

>>> from us_sim.evaluation.hand.cases import TISSUES, motions
>>> [str(motion) for motion in motions(quick=True, seed=1)][0]
'arm, free, brisk'
>>> len(TISSUES["block"].model.mesh.nodes)
2000
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from us_sim.evaluation.block import EXTENT, MESHES
from us_sim.evaluation.named import Named
from us_sim.evaluation.tissue.cases import SCENES
from us_sim.geometry.pose import Pose
from us_sim.recording.hand_motion import HASTES, KINDS, RATE, Room, hand_motion
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import find_scene, load_scene
from us_sim.tissue.model import TissueModel
from us_sim.volume.volume import Volume

__all__ = ["MAIN_TISSUE", "RATE", "TISSUES", "Motion", "Tissue", "motions"]

MAIN_TISSUE = "arm"
APPROACH = 0.5
"""s, in which the probe comes to where a motion begins: these frames do not count."""

_MAIN, _ELSEWHERE = 10.0, 4.0  # s, of a motion on the main tissue and on others
_SIDE_KINDS = 4.0  # s, of a motion that is not free
_QUICK_MOTIONS = (
    (MAIN_TISSUE, "free", "brisk", 2.0),
    (MAIN_TISSUE, "free", "violent", 0.7),
    (MAIN_TISSUE, "rocking", "careful", 0.7),
    ("liver", "fanning", "brisk", 0.5),
    ("block", "sliding", "brisk", 0.7),
    ("block", "stabbing", "violent", 0.7),
)


@dataclass(frozen=True, eq=False)
class Tissue:
    """What is pressed, how a report calls it, and how far the hand may go on it."""

    name: str
    words: str
    colour: str
    make: Callable[[], TissueModel]
    room: Room

    @cached_property
    def model(self) -> TissueModel:
        """Made once.

        Raises:
            UsSimError: it cannot be made.
        """
        return self.make()


def _arm() -> TissueModel:
    scene = load_scene("upper_arm")
    return tissue_model_of(scene, volume_of(scene))


def _liver() -> TissueModel:
    # The scene's volume is not part of the package. It has no labels, so that the tissue is uniform
    # and needs nothing of it: any file stands for it, and an empty volume.
    scene = load_scene("liver_sweep", volume=find_scene("liver_sweep"))
    return tissue_model_of(scene, Volume(np.zeros((1, 1, 1), np.uint8), np.eye(4)))


_BLOCK = SCENES["tilt"]

_ALL = (
    Tissue(
        MAIN_TISSUE,
        "the scene `upper_arm` with its linear probe: skin, fat, muscle, vessels, bone",
        "#0072B2",
        _arm,
        Room(),
    ),
    Tissue(
        "liver",
        "the block of the scene `liver_sweep` with its convex probe: uniform, 6 kPa, held at its "
        "bottom",
        "#009E73",
        _liver,
        Room(edge=0.12),
    ),
    Tissue(
        "block",
        "the uniform block of `us-sim evaluate tissue`, 10 kPa, under a capsule of 25 mm radius",
        "#D55E00",
        lambda: _BLOCK.model(MESHES[0]),
        Room(edge=EXTENT[0][1]),
    ),
)
TISSUES = Named("tissue of the hand evaluation", {tissue.name: tissue for tissue in _ALL})


@dataclass(frozen=True)
class Motion:
    """A motion on a tissue."""

    tissue: str
    kind: str  # of `us_sim.recording.hand_motion.KINDS`
    haste: str  # of `us_sim.recording.hand_motion.HASTES`
    seed: int
    duration: float  # s, without the approach

    def __str__(self) -> str:
        return f"{self.tissue}, {self.kind}, {self.haste}"

    @cached_property
    def poses(self) -> list[Pose]:
        """One a frame, those of the approach first."""
        return hand_motion(
            self.kind,
            self.haste,
            self.seed,
            self.duration,
            TISSUES[self.tissue].room,
            approach=APPROACH,
        ).poses

    @property
    def begins(self) -> int:
        """The frame after the approach."""
        return round(APPROACH * RATE)


def motions(quick: bool, seed: int) -> list[Motion]:
    """All that is measured, in order: a tissue's motions stand together.

    The free hand in every haste on every tissue, the longest on the main one; there every kind in
    every haste, elsewhere every kind in the middle one.
    """
    if quick:
        rows = list(_QUICK_MOTIONS)
    else:
        rows = [
            (tissue, kind, haste, _seconds(tissue, kind))
            for tissue in TISSUES
            for kind in KINDS
            for haste in HASTES
            if tissue == MAIN_TISSUE or kind == "free" or haste == "brisk"
        ]
    order = list(TISSUES)
    found = [Motion(tissue, kind, haste, seed, length) for tissue, kind, haste, length in rows]
    return sorted(found, key=lambda motion: order.index(motion.tissue))


def _seconds(tissue: str, kind: str) -> float:
    if kind != "free":
        return _SIDE_KINDS
    return _MAIN if tissue == MAIN_TISSUE else _ELSEWHERE
