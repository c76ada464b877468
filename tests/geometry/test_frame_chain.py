"""Chains of frames at one time, against the motion that was sampled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.frame_chain import FrameChain
from us_sim.geometry.pose import Pose

MS = 1_000_000  # ns


def turned(angle, place):
    return Pose(place, [0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])


MOTIONS = {  # of each frame in its parent: constant velocities, so that interpolation is exact
    "base": ("map", lambda t: turned(0.0, [0.3 * t, -0.1 * t, 0.0])),
    "arm": ("base", lambda t: turned(0.8 * t, [0.0, 0.0, 0.2])),
    "tool": ("arm", lambda t: turned(-0.5 * t, [0.4, 0.0, 0.1])),
}


def sent(frame, milliseconds):
    parent, motion = MOTIONS[frame]
    return frame, parent, milliseconds * MS, motion(1e-3 * milliseconds)


def true(stamp):
    pose = Pose()
    for _, motion in reversed(MOTIONS.values()):
        pose = motion(1e-9 * stamp) @ pose
    return pose


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    periods=st.tuples(*[st.integers(5, 60)] * 3),
    ahead=st.integers(0, 300),
    seed=st.integers(0, 1000),
)
def test_links_of_any_rates_and_stamps_ahead_make_poses_of_one_time(periods, ahead, seed):
    chain = FrameChain("tool", "map")
    jitter = np.random.default_rng(seed)
    messages = [
        (at + jitter.integers(0, 5), frame, at + (ahead if frame == "base" else 0))
        for frame, period in zip(MOTIONS, periods, strict=True)
        for at in range(0, 1500, period)
    ]
    made = [chain.update_link(*sent(frame, stamp)) for _, frame, stamp in sorted(messages)]
    made = [each for each in made if each is not None]
    assert len(made) >= 1000 // max(periods)
    assert (np.diff([stamp for stamp, _ in made]) > 0).all()
    for stamp, pose in made:
        np.testing.assert_allclose(pose.matrix, true(stamp).matrix, atol=1e-9)


def test_a_fixed_link_is_at_every_time_and_a_chain_of_these_moves_never():
    chain = FrameChain("tool", "map")
    chain.set_fixed_link("tool", "arm", turned(0.0, [0.0, 0.0, 0.1]))
    assert chain.find_links() is None
    chain.set_fixed_link("arm", "map", turned(0.0, [0.0, 0.2, 0.0]))
    assert chain.is_fixed
    stamp, pose = chain.update_link("arm", "map", 5 * MS, turned(0.0, [0.0, 0.3, 0.0]))
    assert stamp == 5 * MS
    np.testing.assert_allclose(pose.position, [0.0, 0.3, 0.1])


def test_a_link_that_stands_still_in_time_is_named_and_frames_that_go_round_are_no_way():
    chain = FrameChain("tool", "arm")
    chain.update_link(*sent("tool", 0))
    other = FrameChain("tool", "base")
    for at in (0, 1000, 2000):
        other.update_link(*sent("arm", at))
    assert chain.find_slowest_link() == ("tool", 0.0)
    other.update_link(*sent("tool", 0))
    assert other.find_slowest_link() == ("tool", 2.0)
    other.update_link("base", "tool", 0, Pose())
    other.update_link("arm", "tool", 0, Pose())
    assert other.find_links() is None


def test_stamps_that_go_back_begin_again_by_a_second_and_are_late_by_less():
    chain = FrameChain("tool", "arm")
    assert chain.update_link(*sent("tool", 5000))[0] == 5000 * MS
    assert chain.update_link(*sent("tool", 4500)) is None
    assert chain.update_link(*sent("tool", 10))[0] == 10 * MS
