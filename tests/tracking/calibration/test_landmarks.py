"""Point registration: axioms, error statistics, published results, and what is refused.

Landmarks from files and from a stylus that touched them.
"""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from us_sim.command.calibration import convert_stamps, read_motion
from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.landmarks import read_landmarks, register_landmarks
from us_sim.tracking.calibration.pivot import find_dwells

CORNERS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.06, 0], [0, 0.06, 0.03], [0.05, 0, 0.04]])
number = st.floats(-1.0, 1.0)
poses = (
    st.tuples(st.tuples(number, number, number), st.tuples(number, number, number, number))
    .filter(lambda p: np.linalg.norm(p[1]) > 1e-3)
    .map(lambda p: Pose(*p))
)


@settings(max_examples=20, deadline=None)
@given(pose=poses, seed=st.integers(0, 1000))
def test_it_is_scipys_rotation_and_moves_with_the_frames(pose, seed):
    rng = np.random.default_rng(seed)
    measured = CORNERS + 1e-3 * rng.standard_normal(CORNERS.shape)
    found = register_landmarks(measured, CORNERS)
    middles = measured.mean(axis=0), CORNERS.mean(axis=0)
    expected, _ = Rotation.align_vectors(CORNERS - middles[1], measured - middles[0])
    np.testing.assert_allclose(found.pose.rotation, expected.as_matrix(), atol=1e-7)
    moved = register_landmarks(measured, pose.transform_points(CORNERS))
    np.testing.assert_allclose(moved.pose.matrix, (pose @ found.pose).matrix, atol=1e-9)
    assert moved.fre == pytest.approx(found.fre)


@pytest.mark.slow
def test_errors_are_as_large_as_the_deviations_and_the_fre_say():
    rng = np.random.default_rng(3)
    noise, pose = 0.4e-3, Pose([0.2, -0.1, 0.7], [0.1, 0.5, -0.2, 0.8])
    exact = pose.inverse().transform_points(CORNERS)
    positions, rotations, squares, variances = [], [], [], []
    for _ in range(400):
        found = register_landmarks(exact + noise * rng.standard_normal(exact.shape), CORNERS)
        positions.append(found.pose.position - pose.position)
        turn = Rotation.from_matrix(found.pose.rotation @ pose.rotation.T)
        rotations.append(turn.as_rotvec())
        squares.append(found.fre**2)
        variances.append(found.deviations**2)
    # FRE² is (1 - 2/N) FLE² (Sibson 1979; Fitzpatrick 1998, eq. 10), FLE² is three variances.
    assert np.mean(squares) == pytest.approx((1 - 2 / 5) * 3 * noise**2, rel=0.08)
    scatter = np.concatenate([np.var(positions, axis=0), np.var(rotations, axis=0)])
    np.testing.assert_allclose(np.mean(variances, axis=0), scatter, rtol=0.25)


def test_a_fake_trackers_landmarks_give_plus_published_registration():
    # PhantomRegistration.results.xml: its landmarks, and what Plus' fake tracker, whose phantom
    # lies at (-75, -50, -150) mm in the reference's frame, made of them: Phantom to Reference.
    phantom = 1e-3 * np.array(
        [
            [104.3, 5.0, 20.0],
            [104.3, 45.0, 20.0],
            [104.3, 45.0, 0.0],
            [104.3, -5.0, 0.0],
            [-34.3, 45.0, 15.0],
            [-34.3, -5.0, 20.0],
            [-34.3, -5.0, 0.0],
            [-34.3, 45.0, 0.0],
        ]
    )
    published = np.array([-75.0002, -50.0, -150.0]) * 1e-3
    reference_from_phantom = register_landmarks(
        phantom, phantom + 1e-3 * np.array([-75.0, -50.0, -150.0])
    )
    # Its stated error is 0.00023 mm, and the limit of Plus' own test 0.001 mm and 0.001°.
    np.testing.assert_allclose(reference_from_phantom.pose.position, published, atol=1e-6)
    np.testing.assert_allclose(reference_from_phantom.pose.rotation, np.eye(3), atol=1.7e-5)


@pytest.mark.parametrize(
    ("measured", "known", "problem"),
    [
        (CORNERS[:2], CORNERS[:2], "at least 3"),
        (CORNERS[:3], CORNERS, "3 and 5"),
        (CORNERS * [1, 0, 0], CORNERS * [1, 0, 0], "measured .*line"),
        (CORNERS * 1000, CORNERS, "metres"),
        (CORNERS[::-1], CORNERS, "order"),
        (CORNERS * [-1, 1, 1], CORNERS, "mirrored"),
        (np.where(CORNERS == 0.03, np.nan, CORNERS), CORNERS, "landmark 4"),
    ],
)
def test_what_cannot_determine_a_registration_is_refused(measured, known, problem):
    with pytest.raises(CalibrationError, match=problem):
        register_landmarks(measured, known)


def written(tmp_path, text, name="points.csv"):
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    return file


def test_a_csv_of_metres_and_of_written_units_is_read(tmp_path):
    points = read_landmarks(
        written(tmp_path, "name, x, y, z, note\na,0.1,0,12 mm,x\nb,1e-2,0,0,\n")
    )
    assert list(points) == ["a", "b"]
    np.testing.assert_allclose(points["a"], [0.1, 0.0, 0.012])
    np.testing.assert_allclose(points["b"], [0.01, 0.0, 0.0])


@pytest.mark.parametrize(
    ("text", "name", "problem"),
    [
        ("", "points.csv", "CSV"),
        ("name,x,y\n", "points.csv", "column z"),
        ("name,x,y,z\na,1,2,nan\n", "points.csv", "landmark a"),
        ("name,x,y,z\na,0,0,0\na,1,0,0\n", "points.csv", "twice"),
        (None, "points.csv", "read"),
    ],
)
def test_what_is_no_list_of_landmarks_is_refused(tmp_path, text, name, problem):
    file = tmp_path / name if text is None else written(tmp_path, text, name)
    with pytest.raises(CalibrationError, match=f"{name}: .*{problem}"):
        read_landmarks(file)


def touching(places, rng, rate=20.0, noise=1e-4):
    """Times, tips and rotations: two seconds on each place, tilting, and one on the way."""
    tips, angles = [], []
    here = np.zeros(3)
    for place in places:
        way = np.linspace(0, 1, int(rate))[:, None]
        tips += [*(here + way * (place - here)), *np.repeat(place[None], int(2 * rate), axis=0)]
        angles += [*np.zeros(int(rate)), *(0.4 * np.sin(np.linspace(0, 6, int(2 * rate))))]
        here = place
    tips = np.array(tips) + noise * rng.standard_normal((len(tips), 3))
    rotations = Rotation.from_euler("y", np.array(angles)[:, None]).as_matrix()
    return np.arange(len(tips)) / rate, tips, rotations


def test_a_place_touched_again_is_the_same_and_a_still_stylus_touches_nothing():
    places = np.array([[0.1, 0, 0], [0, 0.05, 0], [0.1, 0.001, 0]])
    times, tips, rotations = touching(places, np.random.default_rng(0))
    assert len(find_dwells(times, tips, rotations)) == 2
    assert find_dwells(times, tips, np.broadcast_to(np.eye(3), rotations.shape)) == []
    assert find_dwells(times[:1], tips[:1], rotations[:1]) == []


def test_plus_recording_of_eight_landmarks_gives_plus_registration(shared_data):
    folder = shared_data / "plus-tracker-recordings"
    written = ElementTree.parse(folder / "PhantomRegistration.results.xml").iter("Landmark")
    known = 1e-3 * np.array([each.get("Position").split() for each in written], float)
    motion = read_motion(
        folder / "EightLandmarkPointsTrackedForPhantomRegistration.igs.mha", "StylusToReference"
    )
    poses = motion.poses
    # The tip that Plus' own test of this recording is configured with
    # (PlusDeviceSet_fCal_Sim_RecordPhantomLandmarks.xml).
    tip = np.array([0.108565, 0.00777385, 0.0025389])
    dwells = find_dwells(
        convert_stamps(motion),
        np.array([pose.transform_points(tip) for pose in poses]),
        np.array([pose.rotation for pose in poses]),
    )
    assert len(dwells) == len(known) == 8
    found = register_landmarks(known, np.array([dwell.position for dwell in dwells]))
    # PhantomRegistrationLandmarkDetection.results.xml: Phantom to Reference, mean error 0.198 mm.
    published = np.array(
        [
            [-0.00479115, 0.00329566, -0.999983, 0.0227064],
            [-0.0127965, 0.999912, 0.00335674, -0.0397536],
            [0.999907, 0.0128124, -0.00474856, 0.0256504],
        ]
    )
    assert found.residuals.mean() < 0.198046e-3
    np.testing.assert_allclose(found.pose.position, published[:, 3], atol=0.12e-3)
    turn = Rotation.from_matrix(published[:, :3].T @ found.pose.rotation).magnitude()
    # Of this registration's own standard deviations, whose largest is 0.1°.
    assert turn < 3.0 * np.linalg.norm(found.deviations[3:])
    assert np.degrees(turn) < 0.3
