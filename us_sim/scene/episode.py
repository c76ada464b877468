"""Settings of an episode: how a robot or a learner moves the probe, and what differs every time.

>>> from us_sim.scene.episode import EpisodeSettings
>>> episode = EpisodeSettings(speed="40 mm/s", observe=["image", "wrench"])
>>> episode.speed, episode.draws.thickness
(0.04, (0.9, 1.1))
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import SceneError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, rules_of, setting

OBSERVABLE = ("image", "pose", "wrench", "contact", "labels", "displacement", "strain")
"""Entries that an observation may have."""

_FACTOR = Quantity("number", 0.05, 20.0)
_ASIDE = Quantity("length", -0.5, 0.5)
_TURN = Quantity("angle", -1.5, 1.5)


@dataclass(frozen=True)
class DrawRanges(Settings):
    """Ranges, lowest and highest, from which each episode draws; equal ends fix a value."""

    section = "episode.draws"
    error = SceneError

    stiffness: tuple[float, float] = setting(
        _FACTOR, "factor of Young's modulus, for each label; logarithmic", default=(0.7, 1.4)
    )
    lumen_pressure: tuple[float, float] = setting(
        _FACTOR, "factor of the pressure in vessels; logarithmic", default=(0.7, 1.4)
    )
    thickness: tuple[float, float] = setting(
        Quantity("number", 0.5, 2.0), "factor of all depths below the skin", default=(0.9, 1.1)
    )
    lateral: tuple[float, float] = setting(
        _ASIDE, "of the start from the scene's, along x of `patient`", default=(-0.008, 0.008)
    )
    elevational: tuple[float, float] = setting(_ASIDE, "likewise along y", default=(-0.005, 0.005))
    height: tuple[float, float] = setting(
        Quantity("length", 0.0, 0.2), "likewise against z: above the skin", default=(0.001, 0.004)
    )
    tilt: tuple[float, float] = setting(
        _TURN, "of the start about the probe's x and y", default=(-0.1, 0.1)
    )
    rotation: tuple[float, float] = setting(
        _TURN, "of the start about the probe's z", default=(-0.2, 0.2)
    )
    gain: tuple[float, float] = setting(
        Quantity("level", -60.0, 60.0), "added to the scene's", default=(-4.0, 4.0)
    )
    speckle: tuple[int, int] = setting(
        Quantity("number", 0, 2**31), "seed of the phantom, where the volume is one", default=(1, 2)
    )
    position_noise: tuple[float, float] = setting(
        Quantity("length", 0.0, 0.1), "standard deviation of the tracked pose", default=(0.0, 2e-4)
    )
    orientation_noise: tuple[float, float] = setting(
        Quantity("angle", 0.0, 1.0), "likewise, about each axis", default=(0.0, 3e-3)
    )
    delay: tuple[int, int] = setting(
        Quantity("number", 0, 1000), "steps by which observations are late", default=(0, 2)
    )

    def check(self) -> None:
        """Require ranges that go up."""
        for name in rules_of(type(self)):
            low, high = getattr(self, name)
            if low > high:
                raise self.make_error(name, f"goes down, from {low:g} to {high:g}: swap the two")


@dataclass(frozen=True)
class EpisodeSettings(Settings):
    """Episodes of `us_sim.environment`: actions, observations, and what is drawn for each."""

    section = "episode"
    error = SceneError

    period: float = setting(Quantity("time", 1e-3, 1.0), "of a step", default=1 / 30)
    steps: int = setting(
        Quantity("number", 1, 1_000_000), "after which an episode is truncated", default=300
    )
    speed: float = setting(
        Quantity("speed", 1e-4, 1.0), "of the probe at an action of 1", default=0.03
    )
    angular_speed: float = setting(Quantity("angular speed", 1e-3, 10.0), "likewise", default=0.35)
    control: str = setting(
        description="meaning of the action along the probe's axis: its velocity, or a force that "
        "the probe seeks by an admittance",
        choices=("twist", "force"),
        default="twist",
    )
    force: float = setting(
        Quantity("force", 0.1, 200.0), "wanted at an action of 1; none at -1", default=20.0
    )
    force_error: float = setting(
        Quantity("force", 0.01, 200.0),
        "difference from the wanted force at which the admittance moves the probe at full speed",
        default=8.0,
    )
    aside: float = setting(
        Quantity("length", 0.0, 1.0), "farthest from the scene's start along x, y", default=0.02
    )
    lift: float = setting(Quantity("length", 0.0, 1.0), "highest above it", default=0.01)
    press: float = setting(Quantity("length", 0.0, 0.2), "deepest below it", default=0.016)
    lean: float = setting(
        Quantity("angle", 0.0, 1.5), "farthest turn from the scene's start", default=0.6
    )
    observe: tuple[str, ...] = setting(
        description="entries of an observation",
        choices=OBSERVABLE,
        default=("image", "pose", "wrench", "contact"),
    )
    target: str | None = setting(
        description="label of the vessel that tasks are about; not given: the first vein",
        default=None,
    )
    draws: DrawRanges = setting(
        description="ranges of what differs between episodes", default=DrawRanges()
    )
