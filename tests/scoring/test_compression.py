"""Examinations of a vein by compression: good ones, and bad ones that must not pass."""

from dataclasses import replace

import numpy as np
import pytest

from us_sim.errors import ScoreError
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.exercise import Exercise, read_exercise
from us_sim.scoring.metrics import Force, Scan, VesselSection
from us_sim.scoring.motion import Motion

POINTS = (0.01, 0.03, 0.05)  # m along a vein of 6 cm, of which 8 mm are left out at both ends
LINE = CentreLine(np.linspace([0.002, -0.03, 0.013], [0.002, 0.03, 0.013], 61))
CLOSES = 8.0  # N
CLOT = (0.024, 0.036)  # m along the vein


def scanned(keys, clot=None, *, beside=False, artery=1.0, rate=5.0):
    """A scan through keys: s since the one before, m along the vein, and N; linear in between.

    The vein closes in proportion to the force, where a clot is down to 0.4.
    """
    seconds, along, newtons = np.array(keys).T
    ends = np.cumsum(seconds)
    times = np.arange(ends[0], ends[-1], 1 / rate)
    force_times = np.arange(ends[0], ends[-1], 0.02)
    place = np.interp(times, ends, along)
    force = np.interp(times, ends, newtons)
    part = np.maximum(1 - force / CLOSES, 0.0)
    if clot is not None:
        is_held = (place > clot[0]) & (place < clot[1])
        part[is_held] = np.maximum(part[is_held], 0.4)
    if beside:
        part[:] = place = np.full(len(times), np.nan)
    count = len(times)
    lifted = np.interp(times, ends, np.where(newtons > 0.0, 5e-4 * newtons, -5e-3))
    positions = LINE.points[0] + np.outer(np.nan_to_num(place), [0.0, 1.0, 0.0])
    positions[:, 2] += lifted

    def section(part):
        middle = np.zeros(count)
        return VesselSection(times, 1e-5 * part, np.full(count, 1e-5), place, middle, middle)

    return Scan(
        Motion(times, positions, [[0, 0, 0, 1]] * count),
        Force(force_times, np.interp(force_times, ends, newtons)),
        {"vein": section(part), "artery": section(np.full(count, artery))},
        {"vein": LINE, "artery": LINE},
        {} if clot is None else {"vein": clot},
    )


def joined(moves):
    return [key for keys in moves for key in keys]


def press(at, newtons=9.0, rest=0.5):
    """Look at a point, press, hold and let go."""
    return [(1, at, rest), (1, at, rest), (1, at, newtons), (1, at, newtons), (1, at, rest)]


def lift(at):
    return [(0.5, at, 0.0), (0.5, at, 0.0)]


def examination(points=POINTS, newtons=(9.0,) * 3):
    presses = joined(press(at, most) for at, most in zip(points, newtons, strict=True))
    return [(0, points[0], 0.0), (1, points[0], 0.0), *presses, (1, points[-1], 0.5)]


def attempt(seen, **task):
    exercise = read_exercise("compression")
    changed = replace(exercise.assigned, **task)
    made = Exercise("x", replace(exercise.task, given=changed)).begin_attempt(seen.lines)
    made.add_scan(seen)
    return made


def done(seen, **task):
    return [step.is_done for step in attempt(seen, **task).list_steps()]


def test_a_vein_that_is_closed_at_every_point_is_examined():
    made = attempt(scanned(examination()))
    assert [step.is_done for step in made.list_steps()] == [True] * 3
    assert np.allclose([step.target[0] for step in made.list_steps()], LINE.points[[10, 30, 50]])
    assert not made.faults
    assert made.compute_duration() == pytest.approx(15.0, abs=1.2)  # from the first touch


def test_the_probe_slides_lightly_or_is_lifted_from_point_to_point():
    way = sum(
        ([*press(at), *lift(at)] for at in POINTS), [(0, POINTS[0], 0.0), (1, POINTS[0], 0.0)]
    )
    assert done(scanned(way), lift_between=True) == [True] * 3
    made = attempt(scanned(examination()), lift_between=True)
    assert [step.is_done for step in made.list_steps()] == [True, False, False]
    assert "lift" in made.list_steps()[1].seen


def bad(name):
    at = POINTS
    begin = [(0, at[0], 0.0), (1, at[0], 0.0), (1, at[0], 0.5), (1, at[0], 0.5)]
    hard = [(1, at[0], 29.0), (1, at[0], 29.0), (1, at[0], 0.0)]
    slide = [(1, at[1], 0.5), (1, at[1], 0.5), (1, at[1], 14), (1, at[1], 14), (2, at[2], 14)]
    long_press = [(1, at[0], 14.0), (1, at[0], 14.0), (4, at[2], 14.0), (1, at[2], 0.0)]
    tap = [[(0.5, each, 0.5), (0.6, each, 0.5), (0.1, each, 9), (0.1, each, 0.5)] for each in at]
    blow = [[(1, each, 0.0), (0.1, each, 9.0), (1, each, 9.0), (0.1, each, 0.0)] for each in at]
    return {
        "too hard, and sliding while pressed": [*begin, *hard, *slide, (1, at[2], 0.0)],
        "one long press": [*begin, *long_press],
        "without scanning": [*begin, *lift(at[0])],
        "too fast to see it close": [*begin, *joined(tap), (1, at[2], 0.5)],
        "without a look at it open": [begin[0], *joined(blow), (1, at[2], 0.0)],
    }[name]


@pytest.mark.parametrize(
    "name",
    [
        "too hard, and sliding while pressed",
        "one long press",
        "without scanning",
        "too fast to see it close",
        "without a look at it open",
    ],
)
def test_a_bad_examination_does_not_pass(name):
    assert done(scanned(bad(name), rate=10.0)) == [False] * 3


def test_presses_beside_the_vein_count_nowhere():
    assert done(scanned(examination(), beside=True)) == [False] * 3


def test_sliding_and_too_much_force_are_said_at_once_and_stand_in_the_result():
    keys = bad("too hard, and sliding while pressed")
    words = ["over 20 N", "slid"]
    made = attempt(scanned(keys))
    assert len(made.faults) == 2
    assert all(word in fault.what for word, fault in zip(words, made.faults, strict=True))
    early = attempt(scanned(keys[:6]))  # while the force is there
    assert "over 20 N" in early.faults[0].what
    assert "over 20 N" in early.list_steps()[0].seen


def test_a_bad_press_can_be_made_good():
    keys = [*examination(newtons=(9.0, 25.0, 9.0)), *press(POINTS[1]), (1, POINTS[1], 0.5)]
    made = attempt(scanned(keys))
    assert [step.is_done for step in made.list_steps()] == [True] * 3
    assert len(made.faults) == 1


def test_a_point_is_done_when_the_vein_is_open_again():
    keys = examination()[:6]
    step = attempt(scanned(keys)).list_steps()[0]
    assert not step.is_done
    assert "let go" in step.seen


@pytest.mark.parametrize(("clot", "advice"), [(None, "press harder"), (CLOT, "let go")])
def test_who_presses_hard_is_told_to_let_go_at_a_thrombus_alone(clot, advice):
    at = POINTS[1]
    way = [(0, at, 0.0), (1, at, 0.0), (1, at, 0.5), (1, at, 0.5), (1, at, 11.0), (1, at, 11.0)]
    seen = scanned(way, clot=CLOT)  # it is held open, by whatever
    made = attempt(replace(seen, thrombi={} if clot is None else seen.thrombi))
    assert advice in made.list_steps()[1].seen


def test_a_point_that_was_missed_or_not_closed_is_not_done():
    assert done(scanned(examination((0.01, 0.03, 0.04)))) == [True, True, False]
    soft = attempt(scanned(examination(newtons=(9.0, 5.0, 9.0)))).list_steps()
    assert [step.is_done for step in soft] == [True, False, True]
    assert [step.is_missed for step in soft] == [False, True, False]
    assert "not pressed hard" in soft[1].seen


def test_a_thrombus_is_found_by_pressing_hard_where_it_is():
    hard = scanned(examination(newtons=(9.0, 12.0, 9.0)), clot=CLOT)
    assert done(hard) == [True] * 3
    assert done(replace(hard, thrombi={})) == [True, False, True]  # it is open for another reason
    assert done(scanned(examination(), clot=CLOT)) == [True, False, True]


def test_a_jab_at_a_thrombus_is_too_short_to_show_it():
    first, at, last = POINTS
    jab = [
        (1, at, 0.5),
        (1, at, 0.5),
        (0.1, at, 15.0),
        (0.2, at, 15.0),
        (0.1, at, 0.5),
        (1, at, 0.5),
    ]
    way = [(0, first, 0.0), (1, first, 0.0), *press(first), *jab, *press(last), (1, last, 0.5)]
    made = attempt(scanned(way, clot=CLOT)).list_steps()
    assert [step.is_done for step in made] == [True, False, True]
    assert "long enough" in made[1].seen


def test_the_artery_must_stay_open_when_the_vein_closes():
    assert done(scanned(examination(), artery=0.2)) == [False] * 3
    assert done(scanned(examination(), artery=0.2), artery=None) == [True] * 3


def test_without_force_a_closed_vein_is_still_closed():
    assert done(replace(scanned(examination()), force=None)) == [True] * 3


def test_what_is_done_while_nobody_knows_the_force_counts_nothing():
    seen = scanned(examination())
    times, newtons = seen.force.times, seen.force.newtons
    second_press = (times > 7.0) & (times < 10.0)  # shaken so fast that no force is told
    shaken = Force(times[~second_press], newtons[~second_press])
    assert done(replace(seen, force=shaken)) == [True, False, True]
    felt = until(seen, 6.0)
    parts = read_exercise("compression").begin_attempt(seen.lines)
    parts.add_scan(felt)
    parts.add_scan(replace(seen, force=None, since=6.0))  # a piece without any
    assert [step.is_done for step in parts.list_steps()] == [True, False, False]


def test_a_silence_between_two_images_is_no_look():
    first = POINTS[0]
    jab = [(0.1, first, 9.0), (0.1, first, 9.0), (3, first, 9.0), (0.1, first, 0.5)]
    way = [(0, first, 0.0), (1, first, 0.0), (1, first, 0.5), (1, first, 0.5), *jab]
    seen = scanned([*way, (1, first, 0.5)], rate=10.0)
    assert done(seen)[0]
    vein = seen.sections["vein"]
    shown = (vein.times < 3.25) | (vein.times > 6.05)
    cut = VesselSection(*(each[shown] for each in vars(vein).values()))
    assert not done(replace(seen, sections={"vein": cut}), artery=None)[0]


def test_a_scene_that_is_loaded_under_a_pressed_probe_scores_nothing():
    pressed = [(0, POINTS[0], 0.5), *press(POINTS[0])]
    made = attempt(scanned([*pressed, *lift(POINTS[0])]))
    assert not any(step.is_done for step in made.list_steps())
    assert made.compute_duration() is None
    made = attempt(scanned([*pressed, *lift(POINTS[0]), *examination()]))
    assert [step.is_done for step in made.list_steps()] == [True] * 3
    assert [fault.what for fault in made.faults] == ["9.0 N before the begin"]


def test_what_comes_after_the_time_counts_no_more():
    seen = scanned(examination())
    assert done(seen, time_limit=30.0) == [True] * 4
    assert done(seen, time_limit=10.0) == [True, True, False, False]


@pytest.mark.parametrize(
    ("points", "places"),
    [(None, POINTS), (2, (0.008, 0.052)), (1, (0.03,)), ([0.02, "4 cm"], (0.02, 0.04))],
)
def test_points_are_given_by_number_or_place(points, places):
    made = replace(read_exercise("compression").assigned, points=points)
    assert np.allclose(made.place_points(0.06), places)


@pytest.mark.parametrize(("points", "said"), [((0.07,), "60 mm"), ((), "empty"), (0, "empty")])
def test_a_place_that_is_not_there_is_refused(points, said):
    with pytest.raises(ScoreError, match=said):
        attempt(scanned(examination()), points=points)


@pytest.mark.parametrize("cut", [3.0, 7.3, 11.0])
def test_in_pieces_it_is_the_same_as_at_once(cut):
    seen = scanned(bad("too hard, and sliding while pressed") + examination()[2:])
    whole = attempt(seen)
    parts = read_exercise("compression").begin_attempt(seen.lines)
    parts.add_scan(until(seen, cut))
    parts.add_scan(replace(seen, since=cut))
    assert [step[:3] for step in parts.list_steps()] == [step[:3] for step in whole.list_steps()]
    assert parts.faults == whole.faults
    assert parts.compute_duration() == whole.compute_duration()


def until(seen, end):
    def cut(section):
        return VesselSection(*(values[section.times <= end] for values in vars(section).values()))

    keep, kept = seen.motion.times <= end, seen.force.times <= end
    motion = seen.motion
    return replace(
        seen,
        motion=Motion(motion.times[keep], motion.positions[keep], motion.orientations[keep]),
        force=Force(seen.force.times[kept], seen.force.newtons[kept]),
        sections={name: cut(section) for name, section in seen.sections.items()},
    )


def blind(seen, points=("compressible",) * 3, thrombus="none", **task):
    exercise = replace(read_exercise("compression"), feedback="afterwards")
    changed = replace(exercise.assigned, **task)
    made = replace(exercise, task=replace(exercise.task, given=changed)).begin_attempt(seen.lines)
    made.add_scan(seen)
    hidden = made.list_steps()
    made.set_answers(points, thrombus, seen.motion.times[-1])
    return hidden, made


CLOT_THERE = ("compressible", "not compressible", "compressible")


def test_a_blind_examination_tells_nothing_until_all_is_answered():
    seen = scanned(examination(newtons=(9.0, 12.0, 9.0)), clot=CLOT)
    hidden, made = blind(seen, CLOT_THERE, "2")
    told = " ".join(f"{step.what} {step.seen}" for step in hidden)
    assert not any(word in told for word in ("thrombus:", "open", "closed", "vein", "%"))
    assert not any(step.is_done for step in hidden)
    assert made.ended is not None
    assert [step.is_done for step in made.list_steps()] == [True] * 4


@pytest.mark.parametrize(
    ("points", "thrombus", "right"),
    [
        (("compressible",) * 3, "none", [True, False, True, False]),
        (CLOT_THERE, "1", [True, True, True, False]),
        (("not seen",) * 3, "2", [False, False, False, True]),
    ],
)
def test_wrong_answers_are_held_against_the_truth(points, thrombus, right):
    seen = scanned(examination(newtons=(9.0, 12.0, 9.0)), clot=CLOT)
    assert [step.is_done for step in blind(seen, points, thrombus)[1].list_steps()] == right


def test_right_answers_without_an_examination_do_not_pass():
    seen = scanned(bad("without scanning"))
    made = blind(seen)[1]
    assert [step.is_done for step in made.list_steps()] == [False, False, False, True]
    assert "not examined" in made.list_steps()[0].seen


def test_an_answer_ends_a_blind_attempt_only_when_all_are_there():
    _, made = blind(scanned(examination()), ("compressible", "-", "compressible"))
    assert made.ended is None
    made.set_answers(("compressible",) * 3, "none", 20.0)
    assert [step.is_done for step in made.list_steps()] == [True] * 4
    with pytest.raises(ScoreError, match="ended"):
        made.set_answers(("compressible",) * 3, "1", 21.0)


def test_what_comes_late_of_before_the_last_answer_counts():
    seen = scanned(examination())
    exercise = replace(read_exercise("compression"), feedback="afterwards")
    made = exercise.begin_attempt(seen.lines)
    made.add_scan(until(seen, 8.0))
    made.set_answers(("compressible",) * 3, "none", seen.motion.times[-1])
    made.add_scan(replace(seen, since=8.0))
    assert [step.is_done for step in made.list_steps()] == [True] * 4


@pytest.mark.parametrize(
    ("points", "thrombus"), [(("maybe",), ""), (("-",) * 4, ""), (("-",), "4"), (("-",), "some")]
)
def test_an_answer_that_is_none_is_refused(points, thrombus):
    with pytest.raises(ScoreError):
        blind(scanned(examination()), points, thrombus)


def test_where_all_is_said_at_once_nothing_is_asked():
    with pytest.raises(ScoreError, match="asks nothing"):
        attempt(scanned(examination())).set_answers(("compressible",), "", 0.0)
    with pytest.raises(ScoreError, match="compression"):
        replace(read_exercise("keep_force"), feedback="afterwards")


def strayed(across=0.0, turn=0.0):
    """An examination whose probe strays with the force: m, and rad, at 9 N."""
    seen = scanned(examination())
    part = seen.force.interpolate_at(seen.motion.times) / 9.0
    positions = seen.motion.positions + np.outer(across * part, [1.0, 0.0, 0.0])
    half = 0.5 * turn * part
    orientations = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    return replace(seen, motion=Motion(seen.motion.times, positions, orientations))


@pytest.mark.parametrize(
    ("stray", "word"), [({"across": 0.012}, "slid"), ({"turn": np.deg2rad(60)}, "turned")]
)
def test_a_press_that_slides_across_or_turns_does_not_count(stray, word):
    made = attempt(strayed(**stray))
    assert [step.is_done for step in made.list_steps()] == [False] * 3
    assert [fault.what.split()[0] for fault in made.faults] == [word] * 3
    assert done(strayed(across=0.004, turn=np.deg2rad(15))) == [True] * 3


def test_a_light_look_is_acknowledged():
    at = POINTS[0]
    looked = [(0, at, 0.0), (1, at, 0.0), (1, at, 0.5), (1, at, 0.5)]
    assert attempt(scanned(looked)).list_steps()[0].seen == "seen open: press"
    assert attempt(scanned([*looked[:2], (0.2, at, 0.5)])).list_steps()[0].seen == "not reached"
