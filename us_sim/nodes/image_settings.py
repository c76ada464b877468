"""What can be set of the images that ``slice_interpolator`` makes, beside the console's settings.

>>> from us_sim.nodes.image_settings import AnnotatedImageSettings
>>> AnnotatedImageSettings().overlay
'none'
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from us_sim.scene.building import probe_of
from us_sim.scene.scene import Scene
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.slicing.acoustics.settings import SoundSettings, TissueAcoustics

OVERLAYS = ("strain", "strain_estimate", "velocity", "none")
"""Colours over the annotated image, by the names of the streams that they are of."""

_AGE = Quantity("time", 0.01, 3600.0)


@dataclass(frozen=True)
class PoseAgeSettings(Settings):
    """Of ``slice_interpolator``: when an image's pose is old."""

    live = True

    stale_after: float = setting(
        _AGE, "without a new pose before the image is marked stale", default=0.5
    )
    lost_after: float = setting(
        _AGE, "without a new pose before the probe counts as lost", default=2.0
    )


@dataclass(frozen=True)
class AnnotatedImageSettings(Settings):
    """Of ``slice_interpolator``: what the annotated image shows."""

    live = True

    overlay: str = setting(
        description="colours over the annotated image, where the scene can provide them",
        choices=OVERLAYS,
        default="none",
    )
    flip: bool = setting(
        description="left and right exchanged in the annotated image and on the page: the probe's "
        "mark is at the right then",
        default=False,
    )
    beside: bool = setting(
        description="the image without anything over it at the left of the annotated one, of the "
        "same moment",
        default=False,
    )


def image_parameters(scene: Scene) -> Iterator[tuple[str, type[Settings]]]:
    """Settings of a scene that are parameters, too, each with what goes before their names."""
    yield "", type(probe_of(scene))
    yield "acoustics.", SoundSettings
    for label in scene.imaging.acoustics.tissues:
        yield f"acoustics.tissues.{label}.", TissueAcoustics
    yield "m_mode.", type(scene.m_mode)
    if scene.tissue is not None:
        yield "strain.", type(scene.strain)
    if scene.flows:
        yield "colour.", type(scene.colour)
        yield "spectrum.", type(scene.spectrum)
    for name, flow in scene.flows.items():
        yield f"flow.{name}.", type(flow)
