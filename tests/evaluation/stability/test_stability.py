"""The search for instability finds nothing in good solvers, and in broken ones what is broken."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from us_sim.evaluation.stability.cases import (
    HOLD,
    SMALL,
    StabilityCase,
    make_model,
    sample_cases,
    sample_held_cases,
)
from us_sim.evaluation.stability.measure import (
    Trial,
    is_residual_true,
    run_trial,
    try_case,
)
from us_sim.evaluation.stability.report import STABILITY, plan_cases
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.tissue.solvers.fem_cg import FemCg
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear

CASE = StabilityCase("press", depth=0.2, contrast=10.0)


class Lying(FemCg):
    """Reports a hundredth of its residual."""

    def _advance(self, pose):
        deformation = super()._advance(pose)
        return replace(deformation, residual=deformation.residual / 100)


class Drifting(FemCg):
    """Moves one node on and on, and says that nothing happened."""

    def _advance(self, pose):
        deformation = super()._advance(pose)
        self._away = getattr(self, "_away", 0.0) + 0.5
        deformation.nodes[0, 0] += self._away
        return deformation

    def _is_plausible(self, _):
        return True


class NotFinite(FemCg):
    """Ends in a force that is not a number."""

    def _advance(self, pose):
        return replace(super()._advance(pose), force=np.full(3, np.nan))

    def _is_plausible(self, _):
        return True


class Failing(FemCg):
    """Raises what no user understands."""

    def _advance(self, _):
        raise np.linalg.LinAlgError("Singular matrix")


class Stuck(FemCg):
    """Deforms once, and then fails in every frame."""

    def _is_plausible(self, _):
        self._tries = getattr(self, "_tries", 0) + 1
        return self._tries < 3


def tried(solver, case=CASE):
    trial = Trial()
    model = make_model(case)
    run_trial(solver(model), TISSUE_METHODS["fem_cg"].equations(model), case, trial)
    return trial


@pytest.mark.slow
@pytest.mark.parametrize("collider", ["sphere", "plate"])
@pytest.mark.parametrize("method", TISSUE_METHODS)
def test_every_method_passes_and_its_residual_is_not_below_the_least(method, collider):
    trial = try_case(method, replace(CASE, mesh="fine", collider=collider))
    assert not trial.fault
    assert trial.residual_checked < trial.residual_reported + 1e-6


@pytest.mark.slow
def test_a_solver_that_understates_its_residual_is_caught():
    trial = tried(Lying)
    assert trial.finite
    assert trial.bounded
    assert not trial.truthful
    assert trial.fault
    assert trial.residual_checked > 20 * trial.residual_reported


class LyingOfSurfaces(FemNonlinear):
    """As `Lying`, of a method that pushes the surface; stops early, so that there is a residual."""

    def __init__(self, model):
        super().__init__(model, FemNonlinear.Settings(frame_tolerance=0.1))

    def _advance(self, pose):
        deformation = super()._advance(pose)
        return replace(deformation, residual=deformation.residual / 100)


@pytest.mark.slow
def test_a_solver_that_understates_what_the_surface_leaves_is_caught():
    trial, model = Trial(), make_model(CASE)
    equations = TISSUE_METHODS["fem_nonlinear"].equations(model)
    run_trial(LyingOfSurfaces(model), equations, CASE, trial)
    assert not trial.truthful
    assert trial.residual_checked > 20 * trial.residual_reported
    assert not try_case("fem_nonlinear", CASE).fault


def test_broken_solvers_are_caught():
    assert not tried(Drifting).bounded
    assert not tried(NotFinite).finite
    raised = tried(Failing)
    assert not raised.finite
    assert "LinAlgError" in raised.failure
    stuck = tried(Stuck)
    assert stuck.finite
    assert stuck.bounded
    assert stuck.kept > 40
    assert "in every frame" in stuck.failure


HELD = StabilityCase("held", depth=0.2, contrast=10.0, held=HOLD)


@pytest.fixture
def judged(monkeypatch):
    """The method that is broken here is one that must come to balance."""
    method = replace(TISSUE_METHODS["fem_cg"], is_judged_at_rest=True)
    monkeypatch.setitem(TISSUE_METHODS, "fem_cg", method)


class Hesitant(FemCg):
    """Takes a step in a frame, and so never gets there; what it reports is true."""

    def __init__(self, model):
        super().__init__(model, FemCg.Settings(iterations=1))


@pytest.mark.usefixtures("judged")
def test_a_good_solver_comes_to_balance_under_a_held_probe():
    trial = tried(FemCg, HELD)
    assert not trial.fault
    assert len(trial.held) == HOLD + 1
    assert trial.frames_to_balance is not None
    assert trial.held_inverted == 0
    assert trial.recovered_mm == 0.0


def test_tissue_whose_forces_are_in_balance_before_its_nodes_comes_to_balance():
    # Its residual falls below the frame's tolerance while the displacement's error is above.
    trial = try_case("fem_nonlinear", sample_held_cases(40, seed=7)[23])
    assert trial.held[-1] <= 1e-5


@pytest.mark.parametrize(
    "number",
    [
        309,  # swings against its load
        767,  # flies 9 times its size away
        863,  # swings against its load, and stays inside out
    ],
)
def test_springs_with_masses_a_million_times_too_large_stay_bounded_and_say_how_unbalanced(number):
    assert not try_case("msds", sample_cases(1024)[number]).fault


@pytest.mark.usefixtures("judged")
def test_a_solver_that_does_not_come_to_balance_is_caught():
    trial = tried(Hesitant, replace(HELD, mesh="fine", contrast=1000.0))
    assert trial.truthful
    assert trial.frames_to_balance is None
    assert trial.failure.startswith("held for 30 frames it was left with a residual of")


@pytest.mark.usefixtures("judged")
def test_linear_strain_that_turns_tetrahedra_inside_out_is_caught():
    trial = tried(FemCg, replace(HELD, collider="pebble", mesh="fine", depth=0.9))
    assert trial.frames_to_balance is not None
    assert trial.failure.endswith("tetrahedra inside out")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "seed"), [(135, 1), (90, 2), (664, 1), (988, 1)])
def test_a_probe_in_tissue_of_soft_and_stiff_parts_turns_nothing_inside_out(number, seed):
    trial = try_case("fem_nonlinear", sample_held_cases(number + 1, seed)[number])
    assert not trial.failure
    assert trial.held_inverted == 0
    assert trial.held[-1] <= SMALL


@pytest.mark.parametrize(
    ("reported", "checked", "rounding", "true"),
    [
        (0.1, 0.19, 0.0, True),
        (0.1, 0.21, 0.0, False),
        (0.2, 0.01, 0.0, True),
        (0.0, 9e-6, 0.0, True),
        (0.0, 1.1e-5, 0.0, False),
        (0.0, 1.1e-5, 2e-5, True),
        (0.2, float("nan"), 0.0, False),
    ],
)
def test_a_residual_is_true_that_is_not_below_half_of_the_least(reported, checked, rounding, true):
    assert is_residual_true(reported, checked, rounding) is true


@pytest.mark.slow
def test_the_report_has_a_row_for_each_case_and_figures(tmp_path, monkeypatch, capsys):
    many = StabilityCase("many steps", time_step=10.0, stabilisation="substeps")
    cases = [CASE, many, *sample_held_cases(1, seed=3)]
    for name in {*TISSUE_METHODS} - {"fem_cg", "msds"}:
        monkeypatch.delitem(TISSUE_METHODS, name)
    subject = replace(STABILITY, pieces=lambda _: {"stability": plan_cases(cases)})
    assert subject(tmp_path / "out", True) == 0
    with (tmp_path / "out" / "stability.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0])[:3] == ["method", "case", "young_modulus"]
    assert list(rows[0])[-2:] == ["truthful", "action"]
    assert len(rows) == 2 * len(cases)
    ran = {row["method"]: row for row in rows if row["case"] == "press"}
    for row in ran.values():
        assert (row["finite"], row["bounded"], row["truthful"]) == ("true", "true", "true")
        assert row["contrast"] == "10"
    assert ran["fem_cg"]["held_residual"] == ""
    held = {row["method"]: row for row in rows if row["case"] == "held 3.0"}
    assert float(held["fem_cg"]["held_residual"]) < 1e-3
    assert int(held["fem_cg"]["frames_to_1e-3"]) <= HOLD
    assert held["fem_cg"]["held_inverted"] in ("true", "false")
    assert ran["fem_cg"]["time_step"] == ""
    assert ran["msds"]["time_step"] == "0.01"
    refused = next(row for row in rows if row["case"] == "many steps" and row["method"] == "msds")
    assert refused["finite"] == ""
    assert refused["action"].startswith("refused: ")
    report = (tmp_path / "out" / "stability.md").read_text(encoding="utf-8")
    assert "## A probe that is held" in report
    for picture in ("residual", "recovery"):
        assert (tmp_path / "out" / f"stability_{picture}.png").stat().st_size > 10_000
        assert f"stability_{picture}.png" in report
    assert "6 cases, 0 failed" in capsys.readouterr().out
