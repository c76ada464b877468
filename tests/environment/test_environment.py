"""The environment keeps gymnasium's rules, moves as its actions say, and repeats every byte."""

import hashlib
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import us_sim.environment
from us_sim.environment.environment import ScanEnvironment
from us_sim.environment.simulation import EpisodeDraw, ScanSimulation
from us_sim.errors import EpisodeError, SceneError
from us_sim.geometry.pose import Pose
from us_sim.scene.reading import load_scene

STILL = np.zeros(6)
PLAIN = {name: [1, 1] for name in ("stiffness", "lumen_pressure", "thickness", "speckle")}
PLAIN |= {name: [0, 0] for name in ("lateral", "elevational", "height", "tilt", "rotation")}
PLAIN |= {name: [0, 0] for name in ("gain", "position_noise", "orientation_noise", "delay")}
EVERYTHING = ["image", "pose", "wrench", "contact", "labels", "displacement", "strain"]


@pytest.fixture(scope="module")
def scene(small_scene):
    return str(small_scene)


@pytest.fixture(scope="module")
def plain(scene):
    """An environment in which nothing is drawn."""
    settings = {"episode": {"draws": PLAIN, "steps": 100, "observe": EVERYTHING}}
    return ScanEnvironment("HoldContact", scene=scene, settings=settings)


@pytest.mark.slow
@pytest.mark.filterwarnings("error:.*:UserWarning")
@pytest.mark.parametrize("task", us_sim.environment.TASK_NAMES)
def test_gymnasium_finds_no_fault(task, scene):
    environment = gymnasium.make(
        f"us_sim/{task}-v0", scene=scene, render_mode="rgb_array", settings={"skin": None}
    )
    check_env(environment.unwrapped)
    environment.close()
    environment.close()


def bytes_of(environment, steps=12):
    """A digest of all observations and rewards of an episode with random actions."""
    digest = hashlib.sha256()
    random = np.random.default_rng(5)
    for seed in (4, None):
        observation, _ = environment.reset(seed=seed)
        for _ in range(steps):
            for name in sorted(observation):
                digest.update(observation[name].tobytes())
            action = random.uniform(-1, 1, 6)
            action[2] = 1.0  # into the tissue
            observation, reward, *_ = environment.step(action)
            digest.update(np.float64(reward).tobytes())
    return digest.hexdigest()


REPEATED = """
import sys
sys.path[:0] = [{here!r}]
from test_environment import *
print(bytes_of(ScanEnvironment("FindVein", scene={scene!r}, settings={settings!r})))
"""


@pytest.mark.slow
def test_a_seed_decides_every_byte_here_and_in_another_process(scene):
    settings = {"tissue": {"solver": "fem"}, "episode": {"observe": EVERYTHING}}
    environment = ScanEnvironment("FindVein", scene=scene, settings=settings)
    first, again = bytes_of(environment), bytes_of(environment)
    here = __file__.rpartition("/")[0]
    code = REPEATED.format(here=here, scene=scene, settings=settings)
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (first, other.stdout.strip()) == (again, again), other.stderr


@pytest.mark.slow
def test_other_processes_step_as_this_one_does_though_numba_and_threads_are_there(scene):
    def make():
        import us_sim.environment  # noqa: F401 - as in a process of its own

        return gymnasium.make("us_sim/FindVein-v0", scene=scene, settings={"skin": None})

    def run(vector):
        vector.reset(seed=[1, 2])
        actions = np.tile(np.float32([0, 0, 1, 0, 0, 0]), (2, 1))
        seen = [vector.step(actions) for _ in range(8)][-1]
        vector.close()
        return seen

    here = SyncVectorEnv([make, make])
    assert here.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    beside = AsyncVectorEnv([make, make], context="forkserver")
    (one, rewards, *_), (other, same, *_) = run(here), run(beside)
    assert all(np.array_equal(one[name], other[name]) for name in one)
    assert np.array_equal(rewards, same)
    assert one["wrench"][0, 2] < 0.0


def test_an_action_is_a_velocity_in_the_probes_frame(plain):
    turned = Pose(orientation=[0.0, 0.0, np.sin(0.1), np.cos(0.1)])  # by 0.2 rad about z
    plain.reset(options={"rotation": 0.2})
    for _ in range(9):
        observation, *_ = plain.step([0.5, 0, 0.25, 0, 0, 0])
    # 9 steps of 1/30 s at 15 mm/s along x and 7.5 mm/s along z.
    expected = turned.transform_points(np.array([[4.5e-3, 0, 2.25e-3]]))[0]
    assert observation["pose"][:3] == pytest.approx(expected, abs=1e-8)
    for _ in range(6):
        observation, *_ = plain.step([0, 0, 0, 0, 0, -1])
    x, y, z, w = observation["pose"][3:]
    assert 2 * np.arctan2(z, w) == pytest.approx(0.2 - 6 / 30 * 0.35, abs=1e-6)
    assert (x, y) == (0, 0)


def test_the_probe_stays_within_its_space(plain):
    plain.reset()
    for _ in range(60):
        observation, *_ = plain.step([1, -1, 1, 0, 0, 0])
    assert observation["pose"][:3] == pytest.approx([0.02, -0.02, 0.016])


def test_a_wanted_force_is_reached(scene):
    settings = {"episode": {"draws": PLAIN, "control": "force", "force": 10}}
    environment = ScanEnvironment("HoldContact", scene=scene, settings=settings)
    environment.reset()
    for _ in range(100):
        *_, info = environment.step([0, 0, -0.2, 0, 0, 0])  # (1 - 0.2) / 2 of 10 N
    assert info["is_success"]
    assert info["force"] == pytest.approx(4.0, rel=0.01)


@pytest.mark.parametrize(
    ("solver", "skin"),
    [
        ("fem", {}),
        pytest.param("fem_nonlinear", None, marks=pytest.mark.slow),
        pytest.param("fem_cg", None, marks=pytest.mark.slow),
        pytest.param("msds", None, marks=pytest.mark.slow),
    ],
)
def test_a_restored_state_goes_on_with_the_same_bytes(scene, solver, skin):
    draws = PLAIN | {"delay": [2, 2], "position_noise": [1e-3, 1e-3], "stiffness": [0.5, 2]}
    settings = {"tissue": {"solver": solver}, "episode": {"draws": draws, "observe": EVERYTHING}}
    settings |= {"skin": skin} if skin is None else {}
    environment = ScanEnvironment("CompressVein", scene=scene, settings=settings)

    def act(x):
        seen = [environment.step([x, 0, 1, 0, 0, 0]) for _ in range(6)]
        return [(*(o[name].tobytes() for name in EVERYTHING), r, i) for o, r, _, _, i in seen]

    environment.reset(seed=3)
    act(0.0)
    state = environment.state()
    branch, other = act(0.1), act(-0.5)
    environment.restore(state)
    assert act(0.1) == branch
    environment.reset(seed=4)  # other materials
    act(0.0)
    environment.restore(state)
    assert act(0.1) + act(-0.5) == branch + other


def furthest(environment, seed, policy):
    """The return of an episode of a policy that goes on as far as to its own end."""
    _, info = environment.reset(seed=seed)
    total, ended = 0.0, False
    while not ended:
        speed = 1.0
        if policy == "hover" or (policy == "touch" and info["force"] > 0.2):
            speed = 0.0
        elif info["closed"]:
            speed = -1.0 if policy == "release" else 0.0
        _, reward, done, truncated, info = environment.step([0, 0, speed, 0, 0, 0])
        total, ended = total + reward, done or truncated
    assert info["is_success"] == (policy == "release")
    assert info["closed"] == (policy in ("close", "release"))
    return total


@pytest.mark.parametrize("arms", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_who_gets_further_in_compressing_the_vein_returns_more(scene, arms):
    settings = {"tissue": {"solver": "fem"}, "episode": {"steps": 80}}
    if arms == 2:
        straight = {"lateral": [0, 0], "tilt": [0, 0]}
        settings |= {"episode": {"steps": 80, "press": 0.024, "draws": straight}}
    environment = ScanEnvironment("CompressVein", scene if arms == 2 else None, settings=settings)
    for seed in range(arms):
        policies = "hover", "touch", "close", "release"
        returns = [furthest(environment, seed, policy) for policy in policies]
        assert all(np.diff(returns) > 0.0), (seed, returns)


def test_learners_are_told_bounds_channels_and_the_length_of_an_episode(scene):
    settings = {"tissue": {"solver": "fem"}, "episode": {"steps": np.int64(7), "force": 1.0}}
    name = "us_sim.environment:us_sim/CompressVein-v0"
    environment = gymnasium.make(name, scene=scene, settings=settings)
    assert environment.spec.max_episode_steps == 7
    assert environment.observation_space["image"].shape == (80, 96, 1)
    assert environment.observation_space["pose"].high[:3] == pytest.approx(0.02, abs=6e-3)
    _, first = environment.reset(seed=1, options={"height": np.float32(0), "gain": np.zeros(2)})
    steps = [environment.step(np.float32([0, 0, 1, 0, 0, 0])) for _ in range(7)]
    observations, _, _, truncated, infos = zip(*steps, strict=True)
    assert all(seen in environment.observation_space for seen in observations)
    assert all(info.keys() == first.keys() for info in infos)
    assert truncated == (False,) * 6 + (True,)
    assert infos[-1]["cost"] == infos[-1]["force"] - 1.0 > 0.0


def test_a_velocity_is_translated_to_the_force_that_leads_to_it(scene):
    def depths(control):
        settings = {"tissue": {"solver": "fem"}, "episode": {"draws": PLAIN, "control": control}}
        environment = ScanEnvironment(scene=scene, settings=settings)
        environment.reset()
        for z in [0.6] * 8 + [-0.2] * 4:
            environment.step(environment.translate_twist(np.array([0, 0, z, 0, 0, 0])))
            yield environment.truth.pose.position[2]

    assert list(depths("force")) == pytest.approx(list(depths("twist")), abs=1e-9)


def test_an_observation_is_late_by_the_delay(plain):
    def depths(delay):
        first, _ = plain.reset(options={"delay": delay})
        seen = [first] + [plain.step([0, 0, 0.4, 0, 0, 0])[0] for _ in range(5)]
        return [each["pose"][2] for each in seen], [each["wrench"][2] for each in seen]

    for late, now in zip(depths(2), depths(0), strict=True):
        assert late == [*now[:1] * 2, *now[:-2]]


def test_noise_is_as_large_as_it_says(plain):
    plain.reset(seed=1, options={"position_noise": 1e-3})
    seen = np.array([plain.step(STILL)[0]["pose"][:3] for _ in range(100)])
    assert seen.std() == pytest.approx(1e-3, rel=0.2)  # of 300 numbers: 4 %
    assert np.array_equal(plain.truth.pose.position, [0, 0, 0])


def test_following_the_goal_is_no_error(scene):
    settings = {"tissue": {"solver": "fem"}, "episode": {"draws": PLAIN | {"height": [0, 0]}}}
    environment = ScanEnvironment("FollowPlane", scene=scene, settings=settings)
    environment.reset()
    total = 0.0
    for step in range(100):
        # 2 mm down in the first step; then 10 mm and 10 deg in 200 steps.
        down = 2 / 1 if step == 0 else 0
        action = [0, 0.05 / 1, down, 0, 0, np.deg2rad(0.05) * 30 / 0.35]
        _, reward, done, _, info = environment.step(np.clip(action, -1, 1))
        total += reward
        if done:
            break
    assert done
    assert info["plane_error"] < 2e-3
    assert total > 0.95


def test_stiffer_tissue_pushes_back_more_and_moves_alike(scene):
    """Linear elasticity under a prescribed indentation: forces are as the moduli, motion is not."""
    simulation = ScanSimulation(load_scene(scene))
    labels = simulation.scene.tissue.materials
    simulation.reset()
    one = simulation.step(Pose([0, 0, 0.005]))
    simulation.reset(EpisodeDraw(stiffness=dict.fromkeys(labels, 3.0)))
    other = simulation.step(Pose([0, 0, 0.005]))
    assert other.force == pytest.approx(3 * one.force, rel=1e-6)
    assert np.abs(other.frame.nodes - one.frame.nodes).max() < 1e-8


def test_thickness_multiplies_the_depths_of_labels(scene):
    simulation = ScanSimulation(load_scene(scene))

    def depth(thickness):
        simulation.reset(EpisodeDraw(thickness=thickness))
        rows = np.nonzero(
            simulation.compute_labels_at_rest(Pose()) == simulation.find_label("vein")
        )[0]
        return rows.mean()

    assert depth(1.2) == pytest.approx(1.2 * depth(1.0), abs=0.7)  # rows, whose middles are at .5


@pytest.mark.parametrize(
    ("action", "said"),
    [
        ([0, 0, np.nan, 0, 0, 0], "the action .* nan, .* is not six numbers"),
        ([0, 0, 1], "the action .* is not six numbers"),
    ],
)
def test_an_action_that_is_none_is_refused(plain, action, said):
    plain.reset()
    with pytest.raises(EpisodeError, match=said):
        plain.step(action)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"task": "FindVien"}, "task 'FindVien' is not one of .*did you mean 'FindVein'"),
        ({"scene": "upper_arm", "case": "nobody"}, "both given: name one"),
        ({"settings": {"episode": {"target": "aorta"}}}, "the volume has no label `aorta`"),
        ({"settings": {"tissue": None, "skin": None}}, "observe: wrench needs `tissue`"),
    ],
)
def test_what_cannot_be_made_is_said(scene, given, said):
    with pytest.raises((EpisodeError, SceneError), match=said):
        ScanEnvironment(**{"scene": scene} | given if "case" not in given else given)


def test_an_option_that_is_none_is_refused(plain):
    with pytest.raises(SceneError, match=r"options: 'stifness' is not one of .*'stiffness'"):
        plain.reset(options={"stifness": 2})
    with pytest.raises(SceneError, match=r"gain\[0\]: 99 dB is outside -60 to 60 dB"):
        plain.reset(options={"gain": 99})


def test_nothing_can_be_done_before_an_episode_begins(scene):
    environment = ScanEnvironment(scene=scene, settings={"skin": None}, render_mode="rgb_array")
    for act in (environment.render, lambda: environment.step(STILL)):
        with pytest.raises(EpisodeError, match="call reset first"):
            act()
