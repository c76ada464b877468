"""Settings of a stiffness fit: each field is an option of ``us-sim fit-stiffness``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import StiffnessError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class StiffnessSettings(Settings):
    """Young's moduli from a press."""

    error = StiffnessError

    keep: tuple[str, ...] = setting(
        description="structures whose modulus stays as the scene says", default=()
    )
    stiffening: tuple[str, ...] = setting(
        description="structures whose stiffening is fitted besides: the press must be deep",
        default=(),
    )
    poses: int = setting(
        Quantity("number", 12, 2000), "of the press that are looked at, at most", default=48
    )
    pose: str = setting(
        description="topic of the probe's poses in the patient", default="probe/pose"
    )
    wrench: str = setting(
        description="topic of the force and torque on the probe", default="probe/wrench"
    )
    tolerance: float = setting(
        Quantity("time", 1e-4, 1.0), "between a pose and its wrench", default=0.01
    )
    time_offset: float | None = setting(
        Quantity("time", -10.0, 10.0),
        "by which the wrenches' stamps are late; not given: none where both are stamped alike, "
        "else found from loading and unloading",
        default=None,
    )
    largest_offset: float = setting(Quantity("time", 0.01, 10.0), "that is looked for", default=0.3)
    landmarks: Path | None = setting(
        description="CSV name,time,x,y,z of points seen in the tissue: s since the first pose, m; "
        "without a time, the place at rest",
        default=None,
    )
    confidence: float = setting(
        Quantity("number", 0.5, 0.999), "of the stated intervals", default=0.95
    )
    widest: float = setting(
        Quantity("number", 1.05, 100.0),
        "factor of an interval either way, beyond which a modulus counts as not determined",
        default=3.0,
    )
    out: Path = setting(
        description="file to write: a scene with these moduli; a picture goes beside it",
        default=Path("stiffness.yaml"),
    )

    def check(self) -> None:
        """Refuse files that exist, before the work."""
        if self.out.suffix.lower() not in (".yaml", ".yml"):
            raise self.refused("out", f"{self.out}: must be a file that ends in .yaml")
        for file in (self.out, self.picture):
            if file.exists():
                raise self.refused("out", f"{file}: exists already; choose another name")
        if not self.out.absolute().parent.is_dir():
            raise self.refused("out", f"{self.out}: there is no {self.out.absolute().parent}")

    @property
    def picture(self) -> Path:
        """The picture beside the file."""
        return self.out.with_suffix(".png")
