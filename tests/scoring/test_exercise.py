"""Exercises held against scans whose result is known, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from us_sim.errors import ScoreError
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.exercise import Exercise, read_exercise
from us_sim.scoring.metrics import Force, Scan, VesselSection
from us_sim.scoring.motion import Motion
from us_sim.share import shared_roots

POINTS = (0.01, 0.03, 0.05)  # m along a vein of 6 cm, of which 8 mm are left out at both ends
LINE = CentreLine(np.linspace([0.002, -0.03, 0.013], [0.002, 0.03, 0.013], 61))
PRESS = np.array([0.0, 0.5, 1.0, 0.5, 0.0])  # of the deepest, a second each


def scan(left=(0.0, 0.0, 0.0), artery=(0.9, 0.9, 0.9), newtons=(6.0, 6.0, 6.0), points=POINTS):
    """Presses at those points down to a part of the vein's area, with so much force."""
    newtons = np.resize(newtons, len(points))
    count = len(points) * len(PRESS)
    times = np.arange(float(count))
    along = np.repeat(points, len(PRESS))
    positions = LINE.points[np.rint(1e3 * along).astype(int)]
    positions[:, 2] -= np.resize(np.where(PRESS > 0.0, 0.0, 5e-3), count)  # lifted between presses
    motion = Motion(times, positions, [[0, 0, 0, 1]] * count)

    def section(least):
        area = 1e-5 * (1 - np.outer(1 - np.array(least), PRESS).ravel())
        middle = np.zeros(count)
        return VesselSection(times, area, np.full(count, 1e-5), along, middle, middle)

    return Scan(
        motion,
        Force(times, np.outer(newtons, PRESS).ravel()),
        {"vein": section(left), "artery": section(artery)},
        {"vein": LINE, "artery": LINE},
    )


def steps(name, seen, **task):
    exercise = read_exercise(name)
    changed = replace(exercise.assigned, **task)
    attempt = Exercise("x", replace(exercise.task, given=changed)).begin_attempt(seen.lines)
    attempt.add_scan(seen)
    return attempt.list_steps()


def done(name, seen, **task):
    return [step.is_done for step in steps(name, seen, **task)]


def test_without_force_none_is_kept():
    assert done("keep_force", replace(scan(), force=None)) == [False]


def test_a_force_is_kept_as_long_as_it_does_not_leave_its_range():
    times = np.linspace(0, 20, 2001)
    newtons = np.where((times > 2) & (times < 9), 5.5, 0.0)
    newtons[(times > 12) & (times < 16)] = 4.2
    seen = replace(scan(), force=Force(times, newtons))
    assert done("keep_force", seen) == [True]
    assert done("keep_force", seen, duration=7.5) == [False]
    assert done("keep_force", seen, tolerance=0.4) == [False]
    assert steps("keep_force", seen)[0].seen == "held for 7.0 s"
    silent = (times > 4) & (times < 8)  # nobody knows what happened then
    seen = replace(scan(), force=Force(times[~silent], newtons[~silent]))
    assert done("keep_force", seen) == [False]


def with_lateral(lateral, along):
    section = scan().sections["vein"]
    count = len(section.times)
    made = replace(section, lateral=np.resize(lateral, count), along=np.resize(along, count))
    return replace(scan(), sections={"vein": made, "artery": made}, force=None)


def test_a_vessel_is_centred_as_long_as_it_is_in_the_middle():
    lateral = np.full(15, 0.001)
    lateral[[4, 9]] = 0.02, np.nan  # lost for a moment
    assert steps("centre", with_lateral(lateral, 0.0))[0].seen == "held for 4.0 s"
    assert done("centre", with_lateral(lateral, 0.0), duration=4.5) == [False]
    assert done("centre", replace(scan(), sections={})) == [False]
    in_air_between = replace(with_lateral(lateral, 0.0), force=scan().force)
    assert steps("centre", in_air_between)[0].seen == "held for 0.0 s, 2.0 s at most"


def test_a_vessel_is_not_centred_under_too_much_force():
    times = np.arange(15.0)
    for newtons, is_done in ((9.0, True), (11.0, False)):  # of 10 N
        pressed = Force(times, np.where(times > 1.0, newtons, 0.0))
        seen = replace(with_lateral(np.zeros(15), 0.0), force=pressed)
        [step] = steps("centre", seen)
        assert step.is_done == is_done
        assert ("press less" in step.seen) != is_done


def test_nothing_counts_before_a_hand_has_moved_the_probe_in_the_air():
    times = np.linspace(0, 14, 1401)
    late = replace(scan(), force=Force(times, np.where(times < 2.0, 0.0, 5.0)))
    assert done("keep_force", late) == [True]
    still = np.repeat(scan().motion.positions[:1], len(scan().motion), axis=0)
    unmoved = replace(scan().motion, positions=still)
    assert done("keep_force", replace(late, motion=unmoved)) == [False]


def test_every_installed_exercise_can_be_read_and_is_of_a_scene_with_its_vessels():
    files = [f for root in shared_roots() for f in (root / "config/exercises").glob("*.yaml")]
    assert {file.stem for file in files} >= {"compression", "keep_force"}
    for file in files:
        assert read_exercise(file).begin_attempt(scan().lines).list_steps()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: x\ntask: {kind: compresion}", "task.kind"),
        ("name: x\ntask: {kind: keep_force, structure: vein}", "task.structure"),
        ("[1, 2]", "mapping"),
    ],
)
def test_a_file_that_is_no_exercise_is_refused_with_file_and_key(tmp_path, text, said):
    file = tmp_path / "e.yaml"
    file.write_text(text)
    with pytest.raises(ScoreError) as refused:
        read_exercise(file)
    assert str(file) in str(refused.value)
    assert said in str(refused.value)
