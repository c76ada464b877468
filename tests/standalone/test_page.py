"""The number of messages that `docs/standalone.md` states is right."""

from pathlib import Path

import pytest
import rclpy

from us_sim.standalone.interfaces import message_names, packages

PAGE = (Path(__file__).parents[2] / "docs" / "standalone.md").read_text(encoding="utf-8")


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="the real rclpy has other messages")
def test_the_page_counts_the_messages() -> None:
    counts = [len(message_names(package)) for package in packages()]
    assert f"({sum(counts)} in {sum(map(bool, counts))} packages)" in PAGE
