"""The moments of a press that its picture shows."""

from types import SimpleNamespace

import pytest

from us_sim.errors import BagError
from us_sim.recording.press_and_slide import make_press_and_slide
from us_sim.run.contact_sheet import pick_moments


def session_on(path):
    """As a recording of it would be, with an image for every pose."""
    stamps = [int(stamp) for stamp in path.stamps]
    poses = dict(zip(stamps, path.poses, strict=True))
    return SimpleNamespace(list_stamps=lambda _: stamps, poses=poses)


def told(path):
    moments = pick_moments(session_on(path))
    return {title: (stamp - path.stamps[0]) * 1e-9 for title, stamp in moments.items()}


def test_the_scripted_press():
    moments = told(make_press_and_slide())
    assert moments["first touch"] == pytest.approx(1.5, abs=0.02)
    assert moments["full press"] == pytest.approx(3.2, abs=0.3)
    assert moments["last touch"] == pytest.approx(8.7, abs=0.02)


def test_a_path_that_never_touches_has_its_moments_too():
    path = make_press_and_slide(depth=0.0)
    assert len(told(path)) == 3


def test_nothing_to_show():
    with pytest.raises(BagError, match="nothing to show"):
        pick_moments(SimpleNamespace(list_stamps=lambda _: [], poses={}))
