"""A scripted sonographer who examines arms and sees nothing but image and force.

    python tests/scoring/blind_sonographer.py --arms 40

At each point the probe lies on the skin, presses to 12 N, and lets go. What is dark in the image
around the place of the vein is its lumen: where that is there and goes, the vein is compressible.
"""

import argparse
import time

import numpy as np
from scipy.ndimage import gaussian_filter, label

from us_sim.environment.simulation import ScanSimulation
from us_sim.geometry.pose import Pose
from us_sim.scene.building import build_scanner
from us_sim.scene.reading import load_scene
from us_sim.scoring.exercise import read_exercise
from us_sim.scoring.live import LiveScan
from us_sim.scoring.settings import ANSWERS, NO_THROMBUS

COMPRESSIBLE, NOT_COMPRESSIBLE, _ = ANSWERS
PERIOD = 0.2  # s, from image to image
PRESSED_N = 12.0
DARK = 30  # grey value
LUMEN = 8e-6  # m², of which an open vein shows more
PART = 0.5  # of the lumen, of which a closed vein shows less


def dark_area(image, scanner, x, z):
    """The area (m²) of the dark spot that is there, or nearest within 5 mm."""
    probe = scanner.probe
    (rows, columns), (step_x, step_z) = image.shape, probe.pixel_spacing
    across, down = np.meshgrid(
        (np.arange(columns) - 0.5 * (columns - 1)) * step_x, np.arange(rows) * step_z
    )
    smooth = gaussian_filter(image.astype(float), 2.0)
    spots, count = label(smooth < DARK)
    far = np.hypot(across - x, down - z)
    best = [np.min(far[spots == k]) for k in range(1, count + 1)]
    if not best or min(best) > 5e-3:
        return 0.0
    spot = 1 + int(np.argmin(best))
    near = (spots == spot) & (far < 7e-3)
    return float(np.count_nonzero(near)) * step_x * step_z


class Hand:
    """The probe on an arm; every frame is scored as it comes."""

    def __init__(self, scene):
        self.simulation = ScanSimulation(scene)
        volume = self.simulation.volume
        exercise = read_exercise(scene.exercise)
        self.scan = LiveScan(volume, build_scanner(scene, volume), exercise)
        self.time = 0.0

    def look(self, place, press, frames=1):
        """Hold the probe there for some frames; the last state."""
        for _ in range(frames):
            pose = Pose([place[0], place[1], press])
            state = self.simulation.step(pose)
            self.time += PERIOD
            self.scan.add_pose(self.time, pose)
            self.scan.add_force(self.time, state.wrench[:3])
            self.scan.add_labels(self.time, pose, state.labels)
        return state

    def examine(self, place):
        """One point: its answer, from images and forces."""
        scanner = self.simulation.scanner
        self.look(place, -0.003, 3)
        state = self.look(place, 0.001, 4)
        before = dark_area(state.image, scanner, 0.0, 0.012)
        press = 0.001
        while state.force < PRESSED_N and press < 0.014:
            press += 0.001
            state = self.look(place, press)
        state = self.look(place, press, 4)
        after = dark_area(state.image, scanner, 0.0, 0.009)
        self.look(place, 0.001, 3)
        self.look(place, -0.003, 3)
        is_open = before > LUMEN
        return COMPRESSIBLE if is_open and after < PART * before else NOT_COMPRESSIBLE


def examine_arm(seed):
    """Whether all answers of an examination are right, its answers, and its steps."""
    scene = load_scene(f"exercise:examination#{seed}")
    hand = Hand(scene)
    hand.look([0.0, 0.0], -0.01, 3)
    line = hand.scan.lines["vein"]
    task = read_exercise(scene.exercise).assigned
    places = [line.interpolate_point(at) for at in task.place_points(float(line.lengths[-1]))]
    answers = [hand.examine(place) for place in places]
    held = [str(k) for k, answer in enumerate(answers, 1) if answer == NOT_COMPRESSIBLE]
    hand.scan.set_answers(answers, held[len(held) // 2] if held else NO_THROMBUS)
    score = hand.scan.compute_score()
    return all(step.is_done for step in score.steps), answers, score.steps


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--first", type=int, default=1, help="seed")
    asked = parser.parse_args()
    right, random, chance = 0, np.random.default_rng(1), 0
    for seed in range(asked.first, asked.first + asked.arms):
        began = time.monotonic()
        is_right, answers, steps = examine_arm(seed)
        right += is_right
        guessed = random.choice(ANSWERS[:2], len(answers))
        chance += list(guessed) == answers
        told = "" if is_right else "; ".join(f"{step.what}: {step.seen}" for step in steps)
        what = "right" if is_right else "wrong"
        print(f"arm {seed}: {what}, {time.monotonic() - began:.0f} s {told}", flush=True)
    print(f"{right} of {asked.arms} right; guessed like it {chance}")


if __name__ == "__main__":
    main()
