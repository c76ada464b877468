"""The bench that every node test gets."""

from collections.abc import Iterator

import pytest
from bench import Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A bench that is taken down after the test."""
    bench = Bench()
    try:
        yield bench
    finally:
        bench.close()
