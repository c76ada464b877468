"""Landmarks from files and from a stylus that touched them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.tracking.calibration.dwell import find_dwells
from us_sim.tracking.calibration.landmark_file import read_landmarks, read_wires
from us_sim.tracking.calibration.landmarks import register_landmarks
from us_sim.tracking.calibration.recorded_motion import read_motion, seconds_of

PLUS = """<PlusConfiguration><PhantomDefinition><Geometry>
<Pattern Type="NWire"><Wire Name="G1" EndPointFront="30 0 20" EndPointBack="30 40 20"/></Pattern>
<Landmarks><Landmark Name="#1" Position="104.3 5.0 20.0"/></Landmarks>
</Geometry></PhantomDefinition></PlusConfiguration>"""


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


def test_wires_have_two_ends(tmp_path):
    wires = read_wires(written(tmp_path, "name,x1,y1,z1,x2,y2,z2\nG1,0,0,0,0,40 mm,0\n"))
    np.testing.assert_allclose(wires["G1"], [[0, 0, 0], [0, 0.04, 0]])


def test_a_phantom_of_plus_is_in_millimetres(tmp_path):
    file = written(tmp_path, PLUS, "phantom.xml")
    np.testing.assert_allclose(read_landmarks(file)["#1"], [0.1043, 0.005, 0.02])
    np.testing.assert_allclose(read_wires(file)["G1"], [[0.03, 0, 0.02], [0.03, 0.04, 0.02]])


@pytest.mark.parametrize(
    ("text", "name", "problem"),
    [
        ("", "points.csv", "has no column name; its first line must be name,x,y,z"),
        ("name,x,y\n", "points.csv", "has no column z"),
        ("name,x,y,z\n", "points.csv", "holds no landmark"),
        ("name,x,y,z\na,1,2\n", "points.csv", "line 2: z: '' is not a length"),
        ("name,x,y,z\na,1,2,nan\n", "points.csv", "line 2: z: 'nan' is not a length"),
        ("name,x,y,z\na,0,0,0\na,1,0,0\n", "points.csv", "landmark a is there twice"),
        ("name,x,y,z\n,0,0,0\n", "points.csv", "a landmark has no name"),
        ("<a>", "points.xml", "is not XML"),
        ("<a/>", "points.xml", "holds no landmark"),
        ('<a><Landmark Name="p" Position="1 2"/></a>', "points.xml", "Position must be 3 numbers"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a/>', "points.xml", "defines entities"),
    ],
)
def test_what_is_no_list_of_landmarks_is_refused_with_a_sentence(tmp_path, text, name, problem):
    with pytest.raises(CalibrationError, match=problem) as refused:
        read_landmarks(written(tmp_path, text, name))
    assert name in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CalibrationError, match=r"nowhere\.csv: cannot be read: No such file"):
        read_landmarks(tmp_path / "nowhere.csv")


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


def test_touched_places_are_found_in_their_order():
    places = np.array([[0.1, 0, 0], [0.1, 0.05, 0], [0, 0.05, 0.02]])
    dwells = find_dwells(*touching(places, np.random.default_rng(0)))
    assert len(dwells) == 3
    np.testing.assert_allclose([dwell.position for dwell in dwells], places, atol=1e-4)
    assert [round(dwell.start) for dwell in dwells] == [1, 4, 7]


def test_a_place_touched_again_is_the_same_and_a_still_stylus_touches_nothing():
    places = np.array([[0.1, 0, 0], [0, 0.05, 0], [0.1, 0.001, 0]])
    times, tips, rotations = touching(places, np.random.default_rng(0))
    assert len(find_dwells(times, tips, rotations)) == 2
    assert find_dwells(times, tips, np.broadcast_to(np.eye(3), rotations.shape)) == []
    assert find_dwells(times[:1], tips[:1], rotations[:1]) == []


def test_plus_recording_of_eight_landmarks_gives_plus_registration(shared_data):
    folder = shared_data / "plus-tracker-recordings"
    known = read_landmarks(folder / "PhantomRegistration.results.xml")
    motion = read_motion(
        folder / "EightLandmarkPointsTrackedForPhantomRegistration.igs.mha", "StylusToReference"
    )
    poses = motion.poses
    # The tip that Plus' own test of this recording is configured with
    # (PlusDeviceSet_fCal_Sim_RecordPhantomLandmarks.xml).
    tip = np.array([0.108565, 0.00777385, 0.0025389])
    dwells = find_dwells(
        seconds_of(motion),
        np.array([pose.apply(tip) for pose in poses]),
        np.array([pose.rotation for pose in poses]),
    )
    assert len(dwells) == len(known) == 8
    found = register_landmarks(
        np.array(list(known.values())), np.array([dwell.position for dwell in dwells])
    )
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
