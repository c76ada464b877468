"""Pictures of a calibration: where the board was seen, and how two signals agree."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from us_sim.errors import CalibrationError
from us_sim.tracking.calibration.camera import BoardView, CameraCalibration
from us_sim.tracking.calibration.time_offset import PositionSignal, TimeOffset

_CELLS = (16, 12)  # of the coverage's map


def draw_coverage(
    path: Path, calibration: CameraCalibration, views: Sequence[BoardView], names: Sequence[str]
) -> None:
    """Write a PNG: all corners over the image, and each photo's residual.

    Raises:
        CalibrationError: the file exists already.
    """
    camera = calibration.camera
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    image, bars = figure.subplots(1, 2, width_ratios=(4, 3))
    pixels = np.concatenate([view.pixels for view in views])
    extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    counts = np.histogram2d(
        pixels[:, 1],
        pixels[:, 0],
        bins=_CELLS[::-1],
        range=((-0.5, camera.height - 0.5), (-0.5, camera.width - 0.5)),
    )[0]
    shown = image.imshow(np.where(counts, counts, np.nan), extent=extent, cmap="YlGn", alpha=0.6)
    figure.colorbar(shown, ax=image, label="corners", shrink=0.8)
    for view in views:
        image.plot(view.pixels[:, 0], view.pixels[:, 1], ".", markersize=2)
    image.plot(*camera.matrix[:2, 2], "k+", markersize=12)
    image.set(xlim=extent[:2], ylim=extent[2:], xlabel="column", ylabel="row")
    image.set_title(f"corners of {len(views)} photos; + is the principal point")
    order = np.arange(len(views))
    bars.bar(order, calibration.residuals)
    bars.axhline(calibration.rms, color="k", linewidth=0.8)
    bars.set(ylabel="residual (pixels)", title=f"RMS {calibration.rms:.2f} pixels")
    bars.set_xticks(order, names, rotation=90, fontsize=min(8, 300 / len(views)))
    _save(figure, path)


def draw_offset(
    path: Path, found: TimeOffset, moving: PositionSignal, fixed: PositionSignal
) -> None:
    """Write a PNG: both signals with the offset taken into account, and the correlations.

    Raises:
        CalibrationError: the file exists already.
    """
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    signals, correlations = figure.subplots(2, 1, height_ratios=(3, 2))
    sign = np.sign(found.correlation)
    start = fixed.times[0]
    signals.plot(
        moving.times + found.offset - start, sign * _normal(moving.values), label="moving, shifted"
    )
    signals.plot(fixed.times - start, _normal(fixed.values), ".-", markersize=3, label="fixed")
    signals.set(xlabel="s", ylabel="position (standard deviations)")
    signals.set_title(f"offset {1e3 * found.offset:.1f} ± {1e3 * found.deviation:.1f} ms")
    signals.set_xlim(0.0, float(np.ptp(fixed.times)))
    signals.legend(loc="upper right")
    correlations.plot(1e3 * found.tried, found.correlations)
    correlations.axvline(1e3 * found.offset, color="k", linewidth=0.8)
    correlations.set(xlabel="offset (ms)", ylabel="correlation")
    _save(figure, path)


def _normal(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((values - values.mean()) / values.std())


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    try:
        with path.open("xb") as file:
            figure.savefig(file, format="png", dpi=110)
    except FileExistsError:
        raise CalibrationError(f"{path}: exists already; choose another name") from None
