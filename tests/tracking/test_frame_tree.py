"""Ways through a tree of frames: against products of matrices, and where there is none."""

import numpy as np

from us_sim.geometry.pose import FrameTree, Pose


def test_the_pose_along_a_way_is_the_product_of_its_matrices():
    random = np.random.default_rng(3)
    tree, product = FrameTree(), np.eye(4)
    for number in range(5):
        pose = Pose(random.normal(size=3), random.normal(size=4))
        tree.place(f"{number + 1}", f"{number}", pose)
        product = product @ pose.matrix
    np.testing.assert_allclose(tree.pose(tree.chain("5", "0")).matrix, product, atol=1e-12)


def test_frames_that_do_not_meet_or_go_round_have_no_chain():
    tree = FrameTree()
    tree.place("a", "b", Pose())
    tree.place("b", "a", Pose())
    assert tree.chain("a", "world") is None
    assert tree.chain("nowhere", "world") is None
    assert tree.chain("world", "world") == []


def test_a_flood_of_frames_ends():
    tree = FrameTree()
    taken = [tree.place(f"{n}", "world", Pose()) for n in range(1001)]
    assert (taken.count(True), taken[-1]) == (1000, False)
    assert tree.place("5", "world", Pose([1.0, 0, 0]))  # one that is known still moves
