"""Options that other packages add: used, warned of where they break, never in place of ours."""

import logging

import pytest

from us_sim.errors import SettingsError
from us_sim.settings.choice import Choice

ADDED = """
[numbers]
broken = numbers_of_a_lab:Number
decimal = decimal:Decimal
fraction = numbers_of_a_lab:Fraction
"""


@pytest.fixture
def numbers(tmp_path, monkeypatch):
    """A choice to which an installed package adds three options, of which one can be used."""
    folder = tmp_path / "numbers_of_a_lab-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: numbers-of-a-lab\nVersion: 1.0")
    (folder / "entry_points.txt").write_text(ADDED)
    (tmp_path / "numbers_of_a_lab.py").write_text("import what_is_not_installed")
    monkeypatch.syspath_prepend(str(tmp_path))
    return Choice("number", key="kind", group="numbers", fraction="fractions:Fraction")


def test_what_a_package_adds_is_chosen_by_its_name(numbers):
    assert numbers.names == ("fraction", "broken", "decimal")
    assert str(numbers.load("decimal")("0.1")) == "0.1"


def test_a_name_of_ours_is_not_taken_and_that_is_said(numbers, caplog):
    assert numbers.load("fraction")(1, 2) * 2 == 1
    (said,) = caplog.messages
    assert "number fraction" in said
    assert "numbers-of-a-lab" in said


def test_what_cannot_be_imported_is_left_out_told_once_and_refused_when_chosen(numbers, caplog):
    with caplog.at_level(logging.WARNING):
        assert numbers.importable == ("fraction", "decimal")
        assert numbers.importable == ("fraction", "decimal")
    (said,) = (text for text in caplog.messages if "broken" in text)
    assert "numbers_of_a_lab:Number" in said
    assert "numbers-of-a-lab" in said
    with pytest.raises(SettingsError, match="what_is_not_installed"):
        numbers.load("broken")
