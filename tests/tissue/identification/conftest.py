"""A press that is made once for all tests."""

import numpy as np
import pytest
from known_press import KnownPress, block_press


@pytest.fixture(scope="session")
def press() -> KnownPress:
    """Two layers of 6 and 18 kPa, pressed by a sphere."""
    return block_press()


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(7)
