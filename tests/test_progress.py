"""Bars that are drawn late, and what the domain tells them."""

from types import SimpleNamespace

import pytest

from us_sim import progress
from us_sim.command import main
from us_sim.errors import UsSimError
from us_sim.tissue.linear_algebra import compliance
from us_sim.tissue.model import TissueModel


@pytest.fixture
def clock(monkeypatch):
    """Seconds of tqdm's clock, set by hand."""
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    return now


def test_short_work_draws_nothing(clock, capsys):
    show = progress.late_progress("solving")
    for clock[0], fraction in ((0.0, 0.0), (0.4, 0.5), (0.9, 1.0)):
        show(fraction, "half")
    assert capsys.readouterr().err == ""


def test_long_work_draws_a_bar_to_its_end_and_later_work_another(clock, capsys):
    show = progress.late_progress("solving")
    for start in (0.0, 100.0):
        for seconds, fraction in ((0.0, 0.0), (4.0, 0.25), (9.0, 1.0)):
            clock[0] = start + seconds
            show(fraction, "the rest")
        drawn = capsys.readouterr().err
        assert "solving: 100 %" in drawn
        assert drawn.endswith("the rest\n")


def test_a_sentence_begins_on_a_line_of_its_own_below_a_bar_that_was_broken_off(
    clock, capsys, monkeypatch
):
    def fails(_):
        show = progress.late_progress("solving")
        for clock[0], fraction in ((0.0, 0.0), (4.0, 0.25)):
            show(fraction, "half")
        raise UsSimError("there is no such thing")

    parser = SimpleNamespace(parse_args=lambda _: SimpleNamespace(command=fails))
    monkeypatch.setattr(main, "_make_parser", lambda: parser)
    assert main.main([]) == 1
    drawn = capsys.readouterr().err
    assert "solving:  25 %" in drawn
    assert drawn.endswith("\nus-sim: there is no such thing\n")


def test_a_bar_has_no_semaphore_that_a_killed_process_would_leave_behind():
    progress.ProgressBar("solving", 1).close()
    assert not hasattr(progress.ProgressBar.get_lock(), "mp_lock")


def test_the_surface_s_compliance_tells_how_far_it_is(monkeypatch, tmp_path):
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path))
    monkeypatch.setattr(compliance, "_KEPT", 0)
    told = []
    compliance.compute_compliance(
        TissueModel.make_block(), lambda fraction, text: told.append((fraction, text))
    )
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    assert 0.0 < fractions[0] < 0.6 < fractions[-1] == 1.0
    assert {text for _, text in told} == {"compliance of the surface"}
