"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

_BESIDE_THE_PROJECT = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings: US_SIM_TEST_DATA, or shared/data beside the project."""
    folder = Path(os.environ.get("US_SIM_TEST_DATA", _BESIDE_THE_PROJECT))
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is not a folder; set US_SIM_TEST_DATA to one")
    return folder
