"""What can be set of the images that ``slice_interpolator`` makes, beside the console's settings.

>>> from us_sim.nodes.image_settings import AnnotatedImageSettings
>>> AnnotatedImageSettings().overlay
'none'
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

__all__ = ["OVERLAYS", "AnnotatedImageSettings", "PoseAgeSettings"]

OVERLAYS = ("strain", "strain_estimate", "none")
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
