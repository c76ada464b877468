"""How much, and how evenly, the tissue in a strain image is compressed.

>>> import numpy as np
>>> from us_sim.slicing.strain.compression import compression
>>> compression(np.array([[-0.01, -0.01], [-0.02, np.nan]]))
Compression(mean=-0.0133..., quality=0.9428...)
>>> compression(np.array([[0.01, -0.01]]))  # as much is stretched as is compressed
Compression(mean=0.0, quality=0.0)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Compression(NamedTuple):
    """Of all tissue in a strain image."""

    mean: float  # strain, negative where the tissue got shorter; 0 without tissue
    quality: float
    """0 to 1: the mean over the root mean square.

    It is 1 where all tissue is strained alike, and falls where the press slides, turns or lets go
    one part while it presses another. With the signal-to-noise ratio of an elastogram, its mean
    over its standard deviation (Céspedes and Ophir, Ultrasonic Imaging 15:73, 1993), it is
    SNR / √(1 + SNR²): what an even press makes of the image, and not how well it can be tracked.
    """


def compression(strain: NDArray[np.floating]) -> Compression:
    """Of an image (any shape) of strain, NaN where there is no tissue."""
    there = strain[np.isfinite(strain)].astype(np.float64)
    if not there.size:
        return Compression(0.0, 0.0)
    mean, square = float(there.mean()), float(np.square(there).mean())
    return Compression(mean, abs(mean) / square**0.5 if square > 0.0 else 0.0)
