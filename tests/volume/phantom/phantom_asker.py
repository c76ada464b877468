"""A process that asks for a phantom; in a module of its own, which a new process can import."""

import os
from pathlib import Path

import numpy as np

from us_sim.cache import load_or_create
from us_sim.volume.phantom.phantom import make_upper_arm, pack_volume, unpack_volume
from us_sim.volume.volume import Volume


def ask(cache: str, marks: str, start, answers) -> None:
    os.environ["US_SIM_CACHE"] = cache

    def make() -> Volume:
        Path(marks, str(os.getpid())).touch()
        return make_upper_arm(1, 1.5e-3)

    start.wait()
    volume = load_or_create("arm", pack_volume, unpack_volume, make)
    answers.put(int(volume.intensities.sum(dtype=np.int64)))
