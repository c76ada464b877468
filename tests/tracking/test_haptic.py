"""The local model of the contact: a spring wall, the slope of its energy, never a pull.

The handle and the probe: scale, clutch, registration, and work that is the same on both.

Rendering a wall and real tissue: known forces, no steps, no energy, and zero at any doubt.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tissue.solvers.solver import create_solver
from us_sim.tracking.haptic import ContactModel, HapticDevice, HapticRendering
from us_sim.tracking.settings import HapticSettings

SPRING = 350.0  # N/m
SEEDS = st.integers(0, 2**32 - 1)


def random_model(random):
    """Pushed with a few newtons, on a stiffness of all signs."""
    factor = random.normal(size=(6, 6))
    scale = np.diag([1, 1, 1, 0.03, 0.03, 0.03])
    stiffness = scale @ (300 * (factor @ factor.T) / 6 - 50 * np.eye(6)) @ scale
    wrench = random.normal(size=6) * [2, 2, 2, 0.05, 0.05, 0.05]
    return ContactModel(0, Pose(random.normal(size=3), random.normal(size=4)), wrench, stiffness)


def displacement(model, pose):
    turn = se3.rotation_between(model.pose.orientation, pose.orientation)
    return np.concatenate([pose.position - model.pose.position, turn])


def energy_at(model, pose):
    return model.compute_wrench(displacement(model, pose))[0]


def wrench_at(model, pose):
    return model.compute_wrench(displacement(model, pose))[1]


def moved(start, twist):
    return Pose(
        start.position + twist[:3],
        se3.multiply_quaternions(se3.rotation_exp(twist[3:]), start.orientation),
    )


@pytest.mark.parametrize("depth", [0.0, 0.002, 0.005, 0.02])
def test_a_wall_gives_stiffness_times_depth_and_its_energy(depth):
    known = 0.008
    wall = ContactModel(
        0,
        Pose([0.01, 0.0, known]),
        np.array([0.0, 0.0, -SPRING * known, 0.0, 0.0, 0.0]),
        np.diag([0.0, 0.0, SPRING, 0.0, 0.0, 0.0]),
    )
    pressed = Pose([0.0, 0.03, depth])
    np.testing.assert_allclose(wrench_at(wall, pressed)[2], -SPRING * depth, atol=1e-12)
    assert energy_at(wall, pressed) == pytest.approx(0.5 * SPRING * depth**2, abs=1e-15)
    lifted = Pose([0.0, 0.03, -depth])
    np.testing.assert_allclose(wrench_at(wall, lifted), 0.0, atol=1e-12)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_at_its_pose_it_is_the_wrench_and_near_it_falls_by_the_stiffness(seed):
    random = np.random.default_rng(seed)
    model = random_model(random)
    along = np.concatenate([model.push, np.zeros(3)])
    stiff = model.stiffness + 2e3 * np.outer(along, along)  # so that the push ends within 30 mm
    model = dataclasses.replace(model, stiffness=stiff)
    energy, wrench = model.compute_wrench(np.zeros(6))
    np.testing.assert_allclose(wrench, model.wrench, atol=1e-12)
    assert energy >= 0.0
    step = 1e-9 * random.normal(size=6)
    expected = -stiff @ step
    expected[3:] += 0.5 * np.cross(step[3:], wrench[3:])  # a torque's axes turn half as far
    change = (model.compute_wrench(step)[1] - model.compute_wrench(-step)[1]) / 2
    np.testing.assert_allclose(change, expected, atol=1e-11)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_the_wrench_is_what_works_against_the_energy(seed):
    """Anywhere, far beyond where contact ends: force and torque times a small motion."""
    random = np.random.default_rng(seed)
    model = random_model(random)
    here = moved(model.pose, random.normal(size=6) * [0.01, 0.01, 0.01, 0.4, 0.4, 0.4])
    step = 1e-7 * random.normal(size=6)
    gained = energy_at(model, moved(here, step)) - energy_at(model, moved(here, -step))
    assert wrench_at(model, here) @ (2 * step) == pytest.approx(-gained, rel=1e-3, abs=1e-11)


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_where_the_push_has_ended_there_is_nothing(seed):
    model = random_model(np.random.default_rng(seed))
    away = Pose(model.pose.position + 0.5 * model.push, model.pose.orientation)
    np.testing.assert_array_equal(wrench_at(model, away), 0.0)
    assert energy_at(model, away) == 0.0


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_a_light_touch_ends_without_a_kick(seed):
    """Wherever the probe goes, the force along the push stays within a few times what it was."""
    random = np.random.default_rng(seed)
    model = random_model(random)
    light = ContactModel(0, model.pose, 0.01 * model.wrench, model.stiffness)
    size = np.linalg.norm(light.wrench[:3])
    slope = light.stiffness[:, :3] @ light.push
    # However soft the tissue is, the push ends within 30 mm.
    slope[:3] += max(size / 0.03 - light.push @ slope[:3], 0.0) * light.push
    for _ in range(50):
        here = moved(light.pose, random.uniform(-1, 1, 6) * [0.02, 0.02, 0.02, 0.3, 0.3, 0.3])
        deeper = max(0.0, -float(slope @ displacement(light, here)))
        along = float(wrench_at(light, here)[:3] @ light.push)
        assert abs(along) <= (2.5 * size + deeper) * (1 + 1e-9)


def pose(random, way=0.1):
    return Pose(way * random.normal(size=3), random.normal(size=4))


def test_the_probe_goes_as_far_as_the_scale_says_and_turns_as_the_handle():
    arm = HapticDevice(HapticSettings(scale=0.5))
    turn = se3.rotation_exp(np.array([0.0, 0.0, 0.3]))
    body = arm.measure_body(Pose([0.02, 0.0, -0.04], turn), 7)
    assert body.stamp == 7
    np.testing.assert_allclose(body.pose.position, [0.01, 0.0, -0.02], atol=1e-15)
    np.testing.assert_allclose(body.pose.orientation, turn, atol=1e-15)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_clutch_never_moves_the_probe(seed):
    random = np.random.default_rng(seed)
    arm = HapticDevice(HapticSettings(scale=float(random.uniform(0.1, 5.0))))
    for _ in range(3):
        before = arm.measure_body(pose(random), 0).pose
        arm.set_clutch(True)
        held = arm.measure_body(pose(random), 1).pose
        np.testing.assert_allclose(held.matrix, before.matrix, atol=1e-12)
        last = pose(random)
        arm.measure_body(last, 2)
        arm.set_clutch(False)
        np.testing.assert_allclose(arm.measure_body(last, 3).pose.matrix, before.matrix, atol=1e-12)
    # From there a way and a turn of the handle are the probe's, about the same axes.
    twist = 0.01 * random.normal(size=6)
    after = arm.measure_body(moved(last, twist), 4).pose
    np.testing.assert_allclose(
        se3.rotation_between(before.orientation, after.orientation), twist[3:], atol=1e-12
    )
    arm.reset()
    body = arm.measure_body(last, 5).pose
    np.testing.assert_allclose(body.orientation, last.orientation, atol=1e-15)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_probe_moves_as_the_trackers_frames_say(seed):
    """The motion since a pose is that of registration, body and calibration, clutch or not."""
    random = np.random.default_rng(seed)
    registration, calibration = pose(random), pose(random)
    arm = HapticDevice(HapticSettings(scale=2.5), registration, calibration)
    arm.measure_body(pose(random), 0)
    arm.set_clutch(True)
    arm.measure_body(pose(random), 1)
    arm.set_clutch(False)
    first, second = pose(random), pose(random)
    before = registration @ arm.measure_body(first, 2).pose @ calibration
    after = registration @ arm.measure_body(second, 3).pose @ calibration
    motion = arm.compute_probe_motion(before, first, second)
    np.testing.assert_allclose(motion[:3], after.position - before.position, atol=1e-12)
    turned = se3.multiply_quaternions(se3.rotation_exp(motion[3:]), before.orientation)
    np.testing.assert_allclose(Pose(orientation=turned).rotation, after.rotation, atol=1e-12)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_work_at_the_handle_is_work_at_the_probe(seed):
    random = np.random.default_rng(seed)
    arm = HapticDevice(HapticSettings(scale=3.0, force_scale=0.7), pose(random), pose(random))
    handle, probe, wrench = pose(random), pose(random), random.normal(size=6)
    felt = arm.compute_handle_wrench(probe, np.zeros(3), wrench)
    step = 1e-7 * random.normal(size=6)
    motion = arm.compute_probe_motion(probe, handle, moved(handle, step))
    assert felt @ step == pytest.approx(0.7 / 3.0 * (wrench @ motion), rel=1e-5)


MS = 1_000_000
COUPLING = 400.0  # N/m
LOOSE = {"ramp": 0.01, "force_limit": 50.0, "torque_limit": 5.0}


class Wall:
    """Below z = 0 there is a spring, friction nowhere."""

    def model(self, stamp, pose):
        depth = pose.position[2]
        wrench = np.array([0.0, 0.0, -COUPLING * max(depth, 0.0), 0.0, 0.0, 0.0])
        return ContactModel(stamp, pose, wrench, np.diag([0, 0, COUPLING * (depth > 0.0), 0, 0, 0]))


class Tissue:
    """A block of it, by one of the solvers."""

    def __init__(self, name):
        self._solver = create_solver(name, block())

    def model(self, stamp, pose):
        deformation = self._solver.deform(pose)
        turn = pose.rotation
        wrench = np.concatenate([turn @ deformation.force, turn @ deformation.torque])
        stiffness = self._solver.compute_contact_stiffness()
        if stiffness is None:
            stiffness = np.zeros((6, 6))
        return ContactModel(stamp, pose, wrench, stiffness)


class Bench:
    """A handle at 1 kHz, and a tissue that answers after a delay that varies."""

    def __init__(
        self, world, *, delay=(16, 40), seed=0, registration=None, calibration=None, **own
    ):
        settings = HapticSettings(**{**LOOSE, **own})
        registration, calibration = registration or Pose(), calibration or Pose()
        self.arm = HapticDevice(settings, registration, calibration)
        self.rendering = HapticRendering(settings, self.arm)
        self._frames = registration, calibration
        self._world, self._delay = world, delay
        self._random = np.random.default_rng(seed)
        self.answers = []
        self.free = 0
        self.tick = 0
        self.given = 0.0  # J, to the handle
        self.most_given = 0.0
        self.largest = 0.0  # J, of the work done on the tissue so far
        self.last = self.known = None
        self.felt = np.zeros(6)

    def move(self, pose, *, poses=True, models=True):
        """One tick with the handle at a pose; what it feels until the next."""
        now = self.tick * MS
        stamp = now + 1
        if self.last is not None:
            turn = se3.rotation_between(self.last.orientation, pose.orientation)
            way = np.concatenate([pose.position - self.last.position, turn])
            self.given += float(self.felt @ way)
            self.most_given = max(self.most_given, self.given)
            self.largest = max(self.largest, -self.given)
        self.last = pose
        if poses:
            self.rendering.update_pose(stamp, pose, now)
        if models and self.tick >= self.free:
            registration, calibration = self._frames
            probe = registration @ self.arm.measure_body(pose, stamp).pose @ calibration
            lag = int(self._random.integers(*self._delay))
            self.answers.append((self.tick + lag, self._world.model(stamp, probe)))
            self.free = self.tick + lag
        while self.answers and self.answers[0][0] <= self.tick:
            self.known = self.answers.pop(0)[1]
            self.rendering.update_model(self.known, now)
        self.tick += 1
        self.felt = self.rendering.render(now)
        return self.felt


def wall(**own):
    """A bench with a wall that is wholly felt before it answers again."""
    return Bench(Wall(), **{"hand_over": 0.01, **own})


def press(bench, depth, ticks=100, start=-0.002):
    for z in np.linspace(start, depth, ticks):
        bench.move(Pose([0.0, 0.0, z]))
    for _ in range(100):
        bench.move(Pose([0.0, 0.0, depth]))
    return bench.felt


def random_path(random, ticks, depth=0.012):
    """A closed way of the handle, from 4 mm above the tissue into it and back."""
    t = np.linspace(0.0, 1.0, ticks + 1)
    rise = np.minimum(1.0, np.minimum(t, 1 - t) / 0.15)
    window = rise * rise * (3 - 2 * rise)

    def wave(size):
        turns, phase = random.integers(1, ticks // 300, 3), random.uniform(0, 2 * np.pi, 3)
        weight = random.dirichlet(np.ones(3))
        return size * weight @ np.sin(2 * np.pi * turns[:, None] * t + phase[:, None])

    z = -0.004 + window * (0.004 + 0.6 * depth + wave(0.9 * depth))
    ways = np.array([window * wave(0.02), window * wave(0.01), z]).T
    turns = np.array([window * wave(0.15) for _ in range(3)]).T
    return [Pose(way, se3.rotation_exp(turn)) for way, turn in zip(ways, turns, strict=True)]


def test_a_wall_gives_stiffness_times_depth():
    bench = wall()
    felt = press(bench, 0.005, ticks=1000)
    np.testing.assert_allclose(felt, [0, 0, -COUPLING * 0.005, 0, 0, 0], atol=1e-9)
    assert bench.rendering.doubt == ""
    assert -bench.given == pytest.approx(0.5 * COUPLING * 0.005**2, rel=0.02)
    # Deeper, before the tissue has answered.
    felt = bench.move(Pose([0.0, 0.0, 0.0055]), models=False)
    assert felt[2] == pytest.approx(-COUPLING * 0.0055)


def test_scale_and_registration_turn_the_wall_around():
    quarter = Pose([0.3, 0.0, 0.1], se3.rotation_exp(np.array([0.0, -np.pi / 2, 0.0])))
    bench = wall(registration=quarter, scale=2.0, force_scale=0.5)
    # The arm's x is the patient's z: x = -50 mm there is its z = 0, by scale and registration.
    for x in np.linspace(-0.052, -0.047, 100):
        bench.move(Pose([x, 0.0, 0.0]))
    for _ in range(100):
        bench.move(Pose([-0.047, 0.0, 0.0]))
    np.testing.assert_allclose(bench.felt[:3], [-0.5 * COUPLING * 0.006, 0, 0], atol=1e-9)


def test_the_force_grows_slowly_at_first():
    bench = wall(ramp=0.2, delay=(5, 6))
    felt = [bench.move(Pose([0.0, 0.0, 0.005]))[2] for _ in range(300)]
    assert felt[4] == 0.0
    np.testing.assert_allclose(felt[10:200], -COUPLING * 0.005 * np.arange(5, 195) / 200, atol=1e-9)
    assert felt[-1] == pytest.approx(-COUPLING * 0.005)


def test_force_and_torque_stay_within_what_the_arm_may_give():
    bench = Bench(Tissue("fem"), force_limit=2.0, torque_limit=0.01, calibration=Pose([0, 0, 0.1]))
    tilt = se3.rotation_exp(np.array([0.2, 0.0, 0.0]))
    largest = np.zeros(2)
    for z in np.linspace(-0.105, -0.088, 200):
        felt = bench.move(Pose([0.0, 0.0, z], tilt))
        size = [np.linalg.norm(felt[:3]), np.linalg.norm(felt[3:])]
        largest = np.maximum(largest, size)
    np.testing.assert_allclose(largest, [2.0, 0.01], rtol=1e-12)


def test_a_new_answer_makes_no_step():
    """The tissue has become twice as stiff: over the hand-over it is felt little by little."""
    bench = wall(hand_over=0.03, delay=(40, 41))
    press(bench, 0.005)
    stiffer = Wall().model(bench.tick * MS + 1, Pose([0.0, 0.0, 0.005]))
    bench.answers.append((bench.tick, dataclasses.replace(stiffer, wrench=2 * stiffer.wrench)))
    bench.free = bench.tick + 1000
    felt = [bench.felt[2], *(bench.move(Pose([0.0, 0.0, 0.005]))[2] for _ in range(60))]
    assert felt[-1] == pytest.approx(-2 * COUPLING * 0.005)
    assert np.abs(np.diff(felt)).max() == pytest.approx(COUPLING * 0.005 / 30, rel=1e-6)


@pytest.mark.parametrize("name", ["fem", "fem_nonlinear", "fem_cg", "msds"])
def test_no_energy_comes_out_of_a_closed_path(name):
    """Nor at any time on the way: but for what the way of a single tick may be wrong by."""
    bench = Bench(Tissue(name), seed=1)
    for pose in random_path(np.random.default_rng(1), 1500):
        bench.move(pose)
    assert bench.rendering.stops == 0
    assert bench.largest > 5e-3  # J, it was pressed
    assert bench.given < 0.0
    assert bench.most_given < 1e-3 * bench.largest


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_nor_with_scales_frames_limits_noise_and_fewer_poses(seed):
    random = np.random.default_rng(seed)
    registration, calibration = Pose([0.1, 0.2, 0.3], random.normal(size=4)), Pose([0, 0.01, 0.1])
    bench = Bench(
        Tissue("fem"),
        seed=seed,
        registration=registration,
        calibration=calibration,
        scale=2.0,
        force_scale=0.5,
        force_limit=1.5,
        torque_limit=0.05,
        ramp=0.5,
    )
    for k, probe in enumerate(random_path(random, 1500)):
        body = registration.inverse() @ probe @ calibration.inverse()
        noise = 5e-6 * random.normal(size=3)
        if k % 2 == 0:
            handle = Pose(0.5 * body.position + noise, body.orientation)
        bench.move(handle, poses=k % 2 == 0)
    assert bench.rendering.stops == 0
    assert bench.largest > 1e-3
    assert bench.given < 0.0
    assert bench.most_given < 2e-2 * bench.largest


@pytest.mark.parametrize(("mass", "speed"), [(0.05, 0.3), (0.2, 0.15), (1.0, 0.1)])
def test_what_is_thrown_at_the_tissue_does_not_come_back_faster(mass, speed):
    """A mass on the handle, free along z, falls on tissue that answers late."""
    bench = Bench(Tissue("fem_nonlinear"), seed=1)
    z, v, deepest = -0.01, speed, 0.0
    for _ in range(2000):
        felt = bench.move(Pose([0.0, 0.0, z]))
        v += 1e-3 * felt[2] / mass
        z += 1e-3 * v
        deepest = max(deepest, z)
        if z < -0.012:
            break
    assert deepest > 0.002
    assert abs(v) <= 1.002 * speed


def test_the_handle_is_never_pulled_into_the_tissue():
    bench = Bench(Tissue("fem"), seed=5)
    for pose in random_path(np.random.default_rng(5), 1500):
        force = bench.move(pose)[:3]
        push = bench.known.push if bench.known else np.zeros(3)
        assert force @ push >= -1e-12
    assert bench.rendering.stops == 0


def in_the_wall(x=0.0, turn=0.0):
    return Pose([x, 0.0, 0.005], se3.rotation_exp(np.array([0.0, turn, 0.0])))


@pytest.mark.parametrize(
    ("poses", "how", "sentence"),
    [
        ([in_the_wall(0.02)], {}, "20.0 mm"),
        ([in_the_wall(turn=0.5)], {}, "29°"),
        ([in_the_wall()] * 60, {"poses": False}, "no pose"),
        ([in_the_wall()] * 340, {"models": False}, "no model"),
        ([in_the_wall(1e-3 * k) for k in range(22)], {"models": False}, "mm from"),
        ([in_the_wall(turn=0.1 * k) for k in range(7)], {"models": False}, "° from"),
        (
            [in_the_wall()],
            {"first": lambda b: b.rendering.stop_rendering("not finite")},
            "not finite",
        ),
        ([in_the_wall()], {"first": lambda b: b.rendering.set_clutch(True)}, "the clutch is held"),
        ([in_the_wall()], {"first": lambda b: setattr(b, "tick", b.tick - 3000)}, "jumped back"),
    ],
)
def test_at_any_doubt_nothing_is_felt_and_then_again(poses, how, sentence):
    bench = wall()
    assert press(bench, 0.005)[2] == pytest.approx(-COUPLING * 0.005)
    how.get("first", lambda _: None)(bench)
    for pose in poses:
        bench.move(pose, **{key: given for key, given in how.items() if key != "first"})
    assert sentence in bench.rendering.stopped
    assert not bench.felt.any()
    assert bench.rendering.stops == 1
    bench.rendering.set_clutch(False)
    bench.answers.clear()
    bench.free = bench.tick
    last, back = bench.last, Pose([0.0, 0.0, 0.005])
    for part in np.linspace(0.0, 1.0, 40):
        bench.move(se3.interpolate_poses(last, back, part), models=part == 1.0)
    felt = press(bench, 0.004, start=0.005)
    assert felt[2] == pytest.approx(-COUPLING * 0.004)
    assert bench.rendering.stops == 1


def test_a_model_of_before_a_doubt_is_not_believed():
    bench = wall(delay=(30, 31))
    press(bench, 0.005)
    bench.free = bench.tick
    bench.move(Pose([0.0, 0.0, 0.005]))  # asks; the answer comes 30 ms later
    bench.rendering.stop_rendering("something was wrong")
    felt = [bench.move(Pose([0.0, 0.0, 0.005])).any() for _ in range(100)]
    assert not any(felt[:45])  # that answer is not taken, but the next
    assert all(felt[-20:])
