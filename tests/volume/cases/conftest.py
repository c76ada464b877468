"""A small case: a block with a vein in it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.reading import SettingsReader
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.writing import write_labels, write_volume
from us_sim.volume.volume import Volume

PROBE = SettingsReader("probe").read(ProbeSettings, {"aperture": "30 mm", "depth": "40 mm"})


@pytest.fixture(scope="session")
def block() -> Volume:
    """60 × 40 × 50 mm of speckle around a vein along y."""
    grid = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    grid[:3, 3] = [-0.03, -0.02, 0.0]
    grey = np.random.default_rng(1).integers(60, 120, (30, 20, 25), dtype=np.uint8)
    labels = np.zeros_like(grey)
    labels[13:17, :, 8:11] = 6
    grey[labels == 6] = 10
    return Volume(grey, grid, labels, {0: "tissue", 6: "vein"})


@pytest.fixture
def make_case(tmp_path: Path, block: Volume) -> Callable[..., Path]:
    """Make the block's case, with other settings where they are given."""

    def make(
        name: str = "block", settings: CaseSettings | None = None, *, labelled: bool = True
    ) -> Path:
        vein = {"vein": CaseStructure(6)} if labelled else {}
        said = {"structures": vein, "start": CaseStart(), "probe": PROBE}  # to propose takes long
        with new_case(tmp_path / name) as folder:
            write_volume(folder / "volume.nrrd", block)
            if labelled:
                write_labels(folder / "labels.nrrd", block)
            write_case_settings(folder, settings or CaseSettings(name, **said))
        return tmp_path / name

    return make
