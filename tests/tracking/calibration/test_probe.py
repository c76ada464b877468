"""Probe calibration from wires and points whose place is known, with errors, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.probe import PixelSighting, calibrate_probe

SPACING = np.array([1.9e-4, 1.4e-4])
IMAGE = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
CORNER = np.array([0.03, -0.08, 0.05])  # m, pixel (0, 0) in the body's frame
NWIRES = {
    f"{layer}{side}": 1e-3
    * np.array([[x + shift, 0.0, 10.0 * layer], [x + end * (layer % 2 * 2 - 1), 40, 10 * layer]])
    for layer in range(3)
    for side, x, shift, end in (("left", 30, 0, 0), ("oblique", 45, 0, 10), ("right", 60, 0, 0))
}
PIN = {"pin": np.array([[0.2, -0.1, 0.4]])}


def image_to_body(corner=CORNER, spacing=SPACING):
    matrix = np.eye(4)
    matrix[:3, :3] = IMAGE * [*spacing, 1.0]
    matrix[:3, 3] = corner
    return matrix


def sightings(rng, features, count, *, pixel_noise=0.0, pose_noise=0.0, turn=0.5):
    """Each of a random pixel that shows a random place of a random feature.

    The body is turned anyhow, and put where the pixel falls on the feature.
    """
    names = sorted(features)
    made = []
    for k in range(count):
        name = names[k % len(names)]
        feature = np.reshape(features[name], (-1, 3))
        place = feature[0] + rng.uniform(0.2, 0.8) * (feature[-1] - feature[0])
        pixel = rng.uniform([50, 60], [550, 440])
        body = image_to_body()[:3] @ [*pixel, 0.0, 1.0]
        turned = Pose(orientation=Rotation.from_rotvec(turn * rng.standard_normal(3)).as_quat())
        position = place - turned.apply(body) + pose_noise * rng.standard_normal(3)
        pixel = pixel + pixel_noise * rng.standard_normal(2)
        made.append(PixelSighting(name, *pixel, Pose(position, turned.orientation)))
    return made


def deviations(found):
    """(8,) of position, rotation and spacing."""
    return np.sqrt(np.diag(found.covariance))


def errors(found):
    """(8,) what the deviations are of."""
    directions = found.image_to_body[:3, :3] / [*found.spacing, 1.0]
    turn = Rotation.from_matrix(directions @ IMAGE.T).as_rotvec()
    return np.concatenate([found.image_to_body[:3, 3] - CORNER, turn, found.spacing - SPACING])


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000))
def test_exact_n_wires_give_the_image_exactly(seed):
    found = calibrate_probe(sightings(np.random.default_rng(seed), NWIRES, 36), NWIRES)
    np.testing.assert_allclose(found.image_to_body, image_to_body(), atol=1e-9)
    np.testing.assert_allclose(found.spacing, SPACING, rtol=1e-6)
    assert found.rms < 1e-9


def test_a_point_at_an_unknown_place_is_found_too():
    found = calibrate_probe(sightings(np.random.default_rng(2), PIN, 40), {})
    np.testing.assert_allclose(found.image_to_body, image_to_body(), atol=1e-9)
    np.testing.assert_allclose(found.points["pin"], [0.2, -0.1, 0.4], atol=1e-9)


def test_known_pixels_stay_as_they_are():
    rng = np.random.default_rng(5)
    made = sightings(rng, NWIRES, 60, pixel_noise=1.0)
    found = calibrate_probe(made, NWIRES, spacing=SPACING)
    np.testing.assert_array_equal(found.spacing, SPACING)
    assert (deviations(found)[6:] == 0).all()
    assert np.abs(errors(found)[:3]).max() < 3e-4


def related(rng, count, clusters, bias, noise):
    """(count, 3) m errors: of each cluster its own, and those of neighbours correlate by 0.9."""
    own = bias * rng.standard_normal((clusters, 3))
    slow = noise * rng.standard_normal((count // clusters, clusters, 3))
    for k in range(1, len(slow)):
        slow[k] = 0.9 * slow[k - 1] + np.sqrt(1 - 0.9**2) * slow[k]
    return (own + slow).reshape(count, 3)


@pytest.mark.parametrize(
    ("features", "known", "bias", "noise"),
    [
        (NWIRES, NWIRES, 0.0, {"pixel_noise": 2.0}),
        (NWIRES, NWIRES, 2e-4, {"pose_noise": 2e-4}),
        (PIN, {}, 0.0, {"pose_noise": 2e-4}),
    ],
)
def test_errors_are_as_large_as_the_deviations_say(features, known, bias, noise):
    # Of each wire a bias, and errors of the tracker that drift, as real recordings have them.
    rng = np.random.default_rng(11)
    said, happened, edges, apart = [], [], [], []
    count = 90
    for _ in range(40):
        made = sightings(rng, features, count, **{"pixel_noise": 0.0, **noise, "pose_noise": 0.0})
        drift = related(rng, count, len(features), bias, noise.get("pose_noise", 0.0))
        made = [
            replace(seen, pose=Pose(seen.pose.position + error, seen.pose.orientation))
            for seen, error in zip(made, drift, strict=True)
        ]
        found = calibrate_probe(made, known)
        said.append(deviations(found))
        happened.append(errors(found))
        pixels = np.array([[seen.column, seen.row] for seen in made])
        corners = [[c, r, 0, 1] for c in (0, 1) for r in (0, 1)] * np.append(
            np.ptp(pixels, 0), (1, 1)
        )
        corners[:, :2] += pixels.min(axis=0)
        edges.append(found.edge_deviation)
        apart.append(np.linalg.norm(corners @ (found.image_to_body - image_to_body()).T, axis=1))
    for part in (slice(0, 3), slice(3, 6), slice(6, 8)):
        true = np.sqrt(np.mean(np.square(np.array(happened)[:, part])))
        assert np.sqrt(np.mean(np.square(np.array(said)[:, part]))) == pytest.approx(true, rel=0.3)
    worst = np.sqrt(np.mean(np.square(apart), axis=0)).max()
    assert np.sqrt(np.mean(np.square(edges))) == pytest.approx(worst, rel=0.3)


def test_the_body_turned_by_as_much_as_it_did():
    rng = np.random.default_rng(4)
    made = sightings(rng, NWIRES, 90, turn=0.02)
    turns = Rotation.from_quat([seen.pose.orientation for seen in made])
    largest = max((turns * turn.inv()).magnitude().max() for turn in turns)
    assert calibrate_probe(made, NWIRES).turned == pytest.approx(largest, rel=0.15)


def test_wrong_sightings_are_left_out():
    rng = np.random.default_rng(6)
    made = sightings(rng, NWIRES, 120, pose_noise=2e-4)
    for k in range(0, 120, 8):
        made[k] = replace(made[k], column=made[k].column + 150.0)
    found = calibrate_probe(made, NWIRES)
    assert not found.inliers[::8].any()
    assert (~found.inliers).sum() <= 17
    assert np.abs(errors(found)[:3]).max() < 3e-4


def test_the_probes_frame_has_its_origin_at_the_transducer_and_z_along_rows():
    found = calibrate_probe(sightings(np.random.default_rng(1), NWIRES, 36), NWIRES)
    pose = found.probe_pose(300.0, 12.0)
    np.testing.assert_allclose(
        pose.position, image_to_body()[:3] @ [300.0, 12.0, 0.0, 1.0], atol=1e-9
    )
    deeper = image_to_body()[:3] @ [310.0, 62.0, 0.0, 1.0]
    np.testing.assert_allclose(
        pose.apply(np.array([[10 * SPACING[0], 0.0, 50 * SPACING[1]]])), [deeper], atol=1e-9
    )
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


PARALLEL = {
    f"{i}{j}": np.array([[0.02 * i, 0.0, 0.01 * j], [0.02 * i, 0.04, 0.01 * j]])
    for i in range(3)
    for j in range(3)
}


def of_parallel_wires(rng):
    """Seen by a body that does not turn."""
    return sightings(rng, PARALLEL, 60, turn=0.0), PARALLEL


def of_an_unknown_pin(rng):
    """Seen by a body that hardly turns."""
    return sightings(rng, PIN, 60, turn=1e-3, pose_noise=2e-4), {}


def of_one_pixel(rng):
    return [replace(seen, column=300.0, row=200.0) for seen in sightings(rng, PIN, 60)], PIN


def in_millimetres(rng):
    made = [
        replace(seen, pose=Pose(1000 * seen.pose.position, seen.pose.orientation))
        for seen in sightings(rng, NWIRES, 60)
    ]
    return made, {name: 1000 * wire for name, wire in NWIRES.items()}


def too_few(rng):
    return sightings(rng, NWIRES, 7), NWIRES


@pytest.mark.parametrize(
    ("sightings_of", "problem"),
    [
        (of_parallel_wires, "do not determine where"),
        (of_an_unknown_pin, "turn the probe"),
        (of_one_pixel, "all over the image"),
        (in_millimetres, "in metres"),
        (too_few, "8 sightings, not 7"),
    ],
)
def test_sightings_that_do_not_determine_the_image_are_refused(sightings_of, problem):
    with pytest.raises(CalibrationError, match=problem):
        calibrate_probe(*sightings_of(np.random.default_rng(0)))
