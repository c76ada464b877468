"""Pictures of a session's flow: which moments they are of, and that a closed vein shows none."""

import numpy as np
import pytest
import yaml

from us_sim.demo.contact_sheet import colour_pictures
from us_sim.demo.session import LumenAreas, Session
from us_sim.geometry.pose import Pose
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.slicing.flow.doppler import ColourDoppler

VEIN = {"kind": "venous", "direction": [0, -1, 0], "peak_velocity": 0.5, "mean_velocity": 0.2}


@pytest.fixture
def scene(tmp_path, small_scene):
    file = tmp_path / "flow.yaml"
    given = {"structures": {"vein": {"flow": VEIN}}, "colour": {"nyquist_velocity": 0.4}}
    file.write_text(yaml.safe_dump({"based_on": str(small_scene), **given}))
    return load_scene(file)


@pytest.fixture
def session(scene):
    """Ten a second: two above the skin and on it, four pressed flat, two let go."""
    mesh = tissue_model_of(scene, volume_of(scene)).mesh
    poses, nodes = {}, {}
    for k in range(80):
        stamp = int(1e9 + k * 1e8)
        pressed = 20 <= k < 60
        poses[stamp] = Pose([0.0, 0.0, 0.012 if pressed else 0.0 if k > 10 else -0.01])
        squeezed = mesh.nodes.copy()
        squeezed[:, 2] = 0.013 + (squeezed[:, 2] - 0.013) * (0.2 if pressed else 1.0)
        nodes[stamp] = squeezed
    return Session(None, poses, nodes, mesh.nodes, mesh.tetrahedra, {}, {})


def colourful(picture):
    """How many pixels are as blue or red as flow, without the bar at the left."""
    return np.count_nonzero(np.ptp(picture[:, 25:].astype(int), axis=2) > 90)


def test_flow_shows_before_and_after_a_press_and_not_in_it(session, scene):
    pictures = colour_pictures(session, scene)
    assert list(pictures) == ["touched", "full press", "let go"]
    touched, pressed, let_go = (colourful(picture) for picture in pictures.values())
    assert touched > 30
    assert let_go > 30
    assert pressed < 0.3 * touched  # what is left is the vein's outline and its name


def test_a_press_shorter_than_a_heartbeat_has_a_picture_of_its_own(session, scene):
    for k, stamp in enumerate(session.poses):
        session.poses[stamp] = Pose([0.0, 0.0, 0.012 if 20 <= k < 23 else 0.0])
    assert list(colour_pictures(session, scene)) == ["touched", "full press", "let go"]


def test_moments_are_of_images_that_show_the_vessel_whole(session, scene):
    """It is out of the image at first, at the deepest, and at the end."""
    deepest = min(session.poses) + int(2.5e9)
    session.poses[deepest] = Pose([0.0, 0.0, 0.02])
    times = np.arange(80) / 10
    rest = np.where((times < 1.4) | (abs(times - 2.5) < 0.2) | (times > 7.5), np.nan, 1e-5)
    areas = LumenAreas(times, np.zeros(80), {"vein": np.full(80, 1e-5)}, {"vein": rest})
    moments = []
    original = ColourDoppler.estimate
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            ColourDoppler,
            "estimate",
            lambda self, blood, frame: moments.append(frame.time) or original(self, blood, frame),
        )
        assert len(colour_pictures(session, scene, areas)) == 3
    since = np.array(moments) - 1.0  # s
    assert ((since > 1.3) & (abs(since - 2.5) > 0.1) & (since < 7.6)).all()
    areas.at_rest["vein"][:] = np.nan
    assert colour_pictures(session, scene, areas) == {}


def test_there_are_none_of_a_scene_without_flows(session, small_scene):
    assert colour_pictures(session, load_scene(small_scene)) == {}
