"""The time and iterations of a frame, and recovery from tissue inside out, without any tissue."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.tissue.solvers.fem_nonlinear import InversionRecovery
from us_sim.tissue.solvers.frame_budget import LEAST, PERIOD, FrameBudget, FramePace

IDENTITY = np.eye(3)


class Clock:
    """A clock that stands until it is moved on."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def steps_until_over(balanced_after, *, strict=None, live=None):
    """Newton steps, at 0.05 s an iteration, until a frame ends; a step is cut to end in time."""
    clock = Clock()
    budget = FrameBudget(clock)
    budget.begin_frame(10_000, strict, live, moved=True)
    for number in range(1, 101):
        budget.begin_step()
        iterations = min(12, budget.step_iterations)
        clock.now += 0.05 * (iterations + 8)
        budget.end_step(iterations)
        if budget.is_over(balanced=number >= balanced_after):
            break
    limit = strict or 1.25 * (live or math.inf)
    assert clock.now - 100.0 <= limit + 1e-9 or number == 1
    return number


@pytest.mark.parametrize(
    ("limits", "balanced_after", "steps"),
    [
        ({"strict": 4.5}, 1, 4),
        ({"strict": 4.5}, 1000, 4),  # never longer than was set
        ({"strict": 4.7}, 1000, 5),  # the last with fewer iterations
        ({"strict": 4.5, "live": 1.0}, 1000, 4),
        ({"strict": 0.5}, 1000, 1),  # the speed is not known before
        ({"live": 4.5}, 1, 4),
        ({"live": 4.5}, 5, 5),  # live, longer for a balance,
        ({"live": 4.5}, 1000, 6),  # but no more than a quarter
        ({}, 1000, 100),
    ],
)
def test_a_frame_ends_with_its_time_and_a_live_one_when_it_is_balanced(
    limits, balanced_after, steps
):
    assert steps_until_over(balanced_after, **limits) == steps


def test_load_steps_leave_time_and_iterations_for_the_pose_itself():
    clock = Clock()
    budget = FrameBudget(clock)
    budget.begin_frame(100, 10.0, moved=True)
    clock.now += 4.9
    assert budget.allows_load_step
    assert not budget.is_late
    clock.now += 0.2
    assert not budget.allows_load_step
    assert budget.is_late
    budget.begin_frame(100, moved=True)
    budget.spend_iterations(52)  # and 8
    clock.now += 1000.0
    assert budget.allows_load_step
    budget.spend_iterations(0)
    assert not budget.allows_load_step


@pytest.mark.parametrize(("hurried", "frames"), [(True, 1), (False, 11)])
def test_tissue_inside_out_is_begun_anew_after_its_time(hurried, frames):
    recovery = InversionRecovery(IDENTITY)
    recovery.record_frame(2.0 * IDENTITY, True)
    count = 0
    while not recovery.must_restart(hurried=hurried):
        recovery.record_frame(-IDENTITY, False)
        count += 1
    assert count == frames
    np.testing.assert_array_equal(recovery.upright, 2.0 * IDENTITY)
    recovery.record_frame(IDENTITY, True)
    assert not recovery.must_restart(hurried=hurried)
    np.testing.assert_array_equal(recovery.upright, IDENTITY)


@given(st.lists(st.floats(0.0, 0.2), max_size=50), st.floats(0.0, 0.05))
def test_no_frame_gets_more_than_the_first_nor_nothing(durations, sending):
    pace = FramePace(sending, cores=2)
    first = pace.limit
    for duration in durations:
        pace.count_frame(duration)
        assert LEAST <= pace.limit <= first
    pace.reset()
    assert pace.limit == first


@given(st.lists(st.floats(0.0, 1.8 * PERIOD), max_size=50), st.floats(0.0, 0.002))
def test_frames_that_overran_are_made_up_for(wanted, sending):
    """A queue at 60 Hz, in which each other frame keeps to its limit: no pose is skipped."""
    pace = FramePace(sending, cores=2)
    first, free = pace.limit, 0.0
    for k, duration in enumerate(wanted):
        waited = max(0.0, free - k * PERIOD)
        assert pace.limit == pytest.approx(max(first - waited, LEAST))
        if k % 2:
            duration = min(duration, pace.limit)
        free = max(free, k * PERIOD) + duration
        pace.count_frame(duration)
    for _ in range(20):  # whatever came before
        last = pace.limit + sending
        pace.count_frame(last)
    assert last == pytest.approx(first + sending)
