"""A score that grows with its scan: it is that of the whole scan, and no sample is added twice."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from us_sim.errors import ScoreError
from us_sim.geometry.pose import Pose
from us_sim.scoring.exercise import read_exercise
from us_sim.scoring.live import LiveScan
from us_sim.scoring.metrics import Tally
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.volume.volume import Volume

MM = 1e-3
VESSELS = {1: (4.0, 12.0, 3.0), 2: (-6.0, 14.0, 2.0)}  # x, z and radius, mm, along y
NAMES = {0: "tissue", 1: "vein", 2: "artery"}
PROBE = LinearProbe(aperture=0.04, depth=0.03, columns=80, rows=60)
RATE = 50  # poses a second


def arm():
    """A block of 1 mm voxels, 80 mm long, with a straight vein and artery."""
    x, _, z = np.meshgrid(np.arange(-25, 26), np.arange(-40, 41), np.arange(31), indexing="ij")
    labels = np.zeros(x.shape, np.uint8)
    for label, (at, deep, radius) in VESSELS.items():
        labels[np.hypot(x - at, z - deep) <= radius] = label
    to_patient = np.diag([MM, MM, MM, 1.0])
    to_patient[:3, 3] = [-25 * MM, -40 * MM, 0.0]
    return Volume(np.ones_like(labels), to_patient, labels, NAMES)


def seen(pose, _=None, left=1.0, pushed=0.0):
    """Labels in the image, of vessels pressed to a part of their width and pushed aside (mm)."""
    x, z = np.meshgrid(np.linspace(-20, 20, 80) + 1e3 * pose.position[0], np.linspace(0, 30, 60))
    labels = np.zeros(x.shape, np.uint8)
    if abs(pose.position[1]) < 40 * MM:
        for label, (at, deep, radius) in VESSELS.items():
            part = left if label == 1 else 0.5 + 0.5 * left
            labels[np.hypot(x - at - pushed, z - deep) < radius * part] = label
    return labels


def messages(seed, seconds):
    """(arrival, what, arguments) of a hand that slides, presses, leaves the arm, and waits."""
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.5, 1.5, RATE * seconds)) / RATE
    places = np.cumsum(random.normal(0, 0.5, (len(times) // RATE + 2, 2)), axis=0) * [3, 12]
    depth = np.clip(np.sin(times * random.uniform(0.5, 2.0)) * 1.5, 0.0, 1.0)
    depth[times > 1.0] = np.maximum(depth[times > 1.0], 0.05)  # it lies on the skin
    depth[times < 0.5] = 0.0  # and was in the air before
    depth[(times > 0.4 * seconds) & (times < 0.6 * seconds)] = 1.0  # held closed
    holds = (times > 0.6 * seconds) & (times < 0.9 * seconds)  # 4.8 N, the artery in the middle
    depth[holds] = 0.4
    sent = []
    for k, time in enumerate(times.tolist()):
        x, y = MM * np.array(
            [np.interp(time, np.arange(len(places)), places[:, axis]) for axis in (0, 1)]
        )
        turn = 0.2 * np.sin(time)
        if holds[k]:
            x, y, turn = -3.5 * MM, 20 * MM, 0.0
        pose = Pose([x, y, 0.012 * depth[k]], [0, 0, np.sin(turn / 2), np.cos(turn / 2)])
        sent.append((time + random.uniform(0, 0.01), "add_pose", (time, pose)))
        if random.random() < 0.6:
            force = np.array([0.0, 1.0, -12.0]) * depth[k]
            sent.append((time + random.uniform(0.02, 0.3), "add_force", (time, force)))
        if k % 10 == 0:
            pushed = 25.0 * (random.random() < 0.1)
            labels = seen(pose, left=1.0 - depth[k], pushed=pushed)
            sent.append((time + random.uniform(0.05, 0.5), "add_labels", (time, pose, labels)))
    return sorted(sent, key=lambda each: each[0])


def scanned(exercise, seed, seconds):
    """A scan, after each second of it."""
    scan = LiveScan(arm(), SimpleNamespace(probe=PROBE, render_labels=seen), exercise)
    second = 1.0
    for arrival, method, arguments in messages(seed, seconds):
        while arrival > second:
            second += 1.0
            yield scan
        getattr(scan, method)(*arguments)


@pytest.mark.parametrize("name", ["compression", "centre"])
def test_the_score_so_far_is_that_of_all_samples_so_far(name):
    exercise = read_exercise(name)
    told = set()
    for scan in scanned(exercise, 1, 24):
        metrics, steps, faults, seconds = scan.compute_score()[:4]
        whole = scan.build_scan()
        attempt = exercise.begin_attempt(whole.lines)
        counted = attempt.add_scan(whole)
        begin = attempt.touched or 0.0
        expected = [fault._replace(time=fault.time - begin) for fault in attempt.faults]
        assert (faults, seconds) == (expected, attempt.compute_duration())
        expected = list(Tally().add_scan(counted).list_metrics()) if counted is not None else []
        assert [each.label for each in metrics] == [each.label for each in expected]
        for found, known in zip(metrics, expected, strict=True):
            assert found.value == pytest.approx(known.value, rel=1e-9, nan_ok=True), found.label
        for step, known in zip(steps, attempt.list_steps(), strict=True):
            assert step[:3] == known[:3]
            told.add(step.seen)
    assert len(told) >= 3  # something went on


def test_nothing_counts_after_the_end():
    exercise = read_exercise("compression")
    task = replace(exercise.task, given=replace(exercise.assigned, time_limit=4.0))
    exercise = replace(exercise, task=task, feedback="afterwards")
    scores = []
    for scan in scanned(exercise, 1, 24):
        score = scan.compute_score()
        scores += [score] if score is not None and score.has_ended else []
    assert len(scores) > 15
    assert all(score is scores[0] for score in scores)
    with pytest.raises(ScoreError, match="ended"):
        scan.set_answers(["compressible"], "none")
    scan.clear()
    for time in (100.0, 101.0):
        scan.add_pose(time, Pose([0.0, 0.0, 0.0]))
    assert scan.compute_score() is None  # it was felt before, and is not yet
    for time in (100.0, 101.0):
        scan.add_force(time, np.zeros(3))
    assert scan.compute_score() is not None
