"""What was measured of one artefact: a row of image.csv.

>>> from us_sim.evaluation.image.points import Point
>>> Point.of("attenuation", "linear", 20.0, 0.01, -6.0, -6.1, "dB").error_percent.__round__(2)
-1.14
>>> Point.of("strain", "linear", 0.0, 0.02, 0.04, 0.0404, "").error_percent.__round__(2)
1.0
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.evaluation.row import Row


@dataclass(frozen=True)
class Point(Row):
    """One number that an image should show, and what it does show."""

    artefact: str
    probe: str
    tilt_deg: float = float("nan")
    depth_mm: float = float("nan")
    expected: float = float("nan")
    measured: float = float("nan")
    unit: str = ""
    error_percent: float = float("nan")
    ms_median: float = float("nan")  # processor time of an image, where that was measured
    failure: str = ""

    @classmethod
    def of(
        cls,
        artefact: str,
        probe: str,
        tilt: float,
        depth: float,
        expected: float,
        measured: float,
        unit: str,
        *,
        of: float | None = None,
        ms: float = float("nan"),
    ) -> Point:
        """A row; the error of levels in dB is that of the amplitude.

        Args:
            tilt: degrees. depth: m.
            of: what the error is a fraction of; None is the expected value, and of pixels one.
        """
        if unit == "dB":
            error = 100.0 * (10.0 ** ((measured - expected) / 20.0) - 1.0)
        else:
            whole = of or (1.0 if unit == "px" else abs(expected))
            error = 100.0 * (measured - expected) / whole if whole else float("nan")
        return cls(artefact, probe, tilt, 1e3 * depth, expected, measured, unit, error, ms)

    @property
    def title(self) -> str:
        """What it is about."""
        return f"{self.artefact}, {self.probe}, {self.tilt_deg:g}°"
