"""`evaluate image` in small: every artefact against its closed form."""

import csv

import pytest

from us_sim.command.main import main
from us_sim.evaluation.image import report as measure
from us_sim.evaluation.image.measure import Artefact, Point
from us_sim.evaluation.report import Target

ASKED = ["artefact", "probe", "tilt_deg", "depth_mm", "expected", "measured", "unit"]
ASKED += ["error_percent", "ms_median"]


class Broken(Artefact):
    name = "broken"
    title = "Broken"

    def points(self, quick):
        raise ArithmeticError(f"no closed form, quick {quick}")

    def targets(self, points):
        raise AssertionError(f"nothing was measured: {points}")

    def report(self, points, folder):
        raise AssertionError(f"nothing was measured: {points} {folder}")


class Even(Artefact):
    name = "even"
    title = "Even"

    def points(self, quick):
        return [Point.of("even", "linear", 10.0, 0.02, 2.0, 2.1, "mm")] if quick else []

    def targets(self, points):
        return [Target.at_most("an even error", 6, points[0].error_percent, "%")]

    def report(self, points, folder):
        return f"There are {len(points)} of {folder.subject}."


def test_the_report_has_every_artefact_and_says_which_broke(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(measure, "ARTEFACTS", (Broken(), Even()))
    assert main(["evaluate", "image", "--quick", "--out", str(tmp_path)]) == 1
    report = (tmp_path / "image.md").read_text(encoding="utf-8")
    assert "## Broken\n\n## Even\n\nThere are 1" in report
    assert "ArithmeticError: no closed form, quick True" in report
    assert "broken" in capsys.readouterr().out
    with (tmp_path / "image.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0])[: len(ASKED)] == ASKED
    assert rows[1]["error_percent"] == "5"


TIMED, RATIO = ["run_time"], " over the plain slice"  # what others do on the machine decides, too


@pytest.mark.slow
@pytest.mark.parametrize(
    "artefact",
    [one for one in measure.ARTEFACTS if one.name not in TIMED],
    ids=lambda one: one.name,
)
def test_what_is_asked_of_an_artefact_is_met(artefact):
    points = artefact.points(quick=True)
    assert not [point for point in points if point.failure]
    targets = artefact.targets(points)
    assert targets
    missed = [target.what for target in targets if target.met is not True]
    assert [what for what in missed if RATIO not in what] == []
