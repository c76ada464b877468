"""The written agent does its task by the image alone, and finds spots where they were drawn."""

import cv2
import numpy as np
import pytest

from us_sim.environment.agents import VisualServo, find_dark_spots
from us_sim.environment.environment import ScanEnvironment


def test_spots_are_where_they_were_drawn_and_the_largest_comes_first():
    random = np.random.default_rng(1)
    image = random.rayleigh(60, (256, 256)).clip(0, 255).astype(np.uint8)
    for centre, axes in (((150, 90), (24, 15)), ((90, 100), (13, 13)), ((250, 200), (20, 20))):
        cv2.ellipse(image, centre, axes, 0, 0, 360, 5, -1)  # the last crosses the border
    large, small = find_dark_spots(image)
    assert large.centre == pytest.approx((150, 90), abs=1)
    assert small.centre == pytest.approx((90, 100), abs=1)
    assert large.area == pytest.approx(np.pi * 24 * 15, rel=0.1)
    assert find_dark_spots(np.zeros((256, 256), np.uint8)) == []


@pytest.mark.slow
def test_the_vein_is_closed_and_let_go_by_the_image_alone():
    episode = {"steps": 150, "observe": ["image"]}
    environment = ScanEnvironment("CompressVein", settings={"episode": episode})
    observation, _ = environment.reset(seed=7)
    agent, done, truncated, least = VisualServo(), False, False, 1.0
    while not (done or truncated):
        observation, _, done, truncated, info = environment.step(agent.act(observation))
        least = min(least, info["target_area_fraction"])
    assert done
    assert least < 0.27
