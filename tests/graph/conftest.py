"""Whole runs of the command, in processes of their own."""

from pathlib import Path

import numpy as np
import pytest
from command import us_sim

from us_sim.recording.path import ProbePath, write_path

RATE_HZ = 60.0


@pytest.fixture(scope="session")
def short_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A press of 8 mm and its release, 1.5 s long."""
    file = tmp_path_factory.mktemp("path") / "short.mcap"
    count = 90
    stamps = (1_700_000_000 * 10**9 + np.arange(count) * 1e9 / RATE_HZ).astype(np.int64)
    positions = np.zeros((count, 3))
    positions[:, 2] = 0.008 * np.sin(np.linspace(0, np.pi, count)) - 0.001
    orientations = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    write_path(file, ProbePath("/tracker/pose", "patient", stamps, positions, orientations))
    return file


@pytest.fixture(scope="session")
def played_scene(small_scene: Path, short_path: Path) -> Path:
    """The small scene with the short path in it."""
    file = small_scene.with_name("played.yaml")
    file.write_text(small_scene.read_text() + f"path: {short_path}\n")
    return file


@pytest.fixture(scope="session")
def demo(small_scene: Path, short_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `us-sim demo` leaves, of a scene without a path of its own."""
    out = tmp_path_factory.mktemp("demo") / "out"
    result = us_sim("demo", small_scene, "--path", short_path, "--out", out)
    assert result.returncode == 0, result.stderr
    assert "images out" in result.stdout
    return out
