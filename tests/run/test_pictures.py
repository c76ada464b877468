"""Pictures of a session: moments of a press, flow, and strain."""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from us_sim.errors import BagError
from us_sim.evaluation.hand.hand_motion import hand_motion, shipped_hand_path
from us_sim.geometry.pose import Pose
from us_sim.recording.press_and_slide import press_and_slide
from us_sim.run.contact_sheet import _moments, _place, colour_pictures, strain_pictures
from us_sim.run.session_summary import Session
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.scoring.lumen import LumenAreas
from us_sim.slicing.flow.doppler import ColourDoppler


def session_on(path):
    """As a recording of it would be, with an image for every pose."""
    stamps = [int(stamp) for stamp in path.stamps]
    return SimpleNamespace(images=stamps, poses=dict(zip(stamps, path.poses, strict=True)))


def told(path):
    """Seconds since the begin, by title."""
    return {title: (stamp - path.stamps[0]) * 1e-9 for title, stamp in _moments(session_on(path))}


def test_the_scripted_press():
    moments = told(press_and_slide())
    assert moments["before"] == 0
    assert moments["first touch"] == pytest.approx(1.5, abs=0.02)
    assert moments["pressing"] == pytest.approx(2.5, abs=0.02)
    assert moments["full press"] == pytest.approx(3.2, abs=0.3)
    assert moments["slid aside"] == pytest.approx(6.25, abs=0.02)
    assert moments["after"] == pytest.approx(9.983, abs=0.001)


@pytest.mark.parametrize("path", [shipped_hand_path(), hand_motion("free", "brisk", 2, 4.0)])
def test_a_hand(path):
    moments = told(path)
    assert list(moments.values()) == sorted(moments.values())
    depth = np.array([pose.position[2] for pose in path.poses])
    deepest = depth[round(60 * moments["full press"])]
    assert deepest == pytest.approx(depth.max(), abs=1e-4)
    assert depth[round(60 * moments["slid aside"])] >= deepest / 2


def test_a_path_that_never_touches_has_its_moments_too():
    path = press_and_slide(depth=0.0)
    assert len(told(path)) == 6


def test_nothing_to_show():
    with pytest.raises(BagError, match="nothing to show"):
        _moments(SimpleNamespace(images=[], poses={}))


def test_a_tilt_is_said_where_there_is_one():
    assert _place(Pose([0.0, 0.0, 0.0123])) == "pressed 12.3 mm"
    tilted = Pose([0.0, 0.0, -0.01], [np.sin(np.radians(10)), 0.0, 0.0, np.cos(np.radians(10))])
    assert _place(tilted) == "in the air, 10.0 mm high, tilted 20°"


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
    touched, pressed, let_go = (colourful(picture.pixels) for picture in pictures.values())
    assert touched > 30
    assert let_go > 30
    assert pressed < 0.3 * touched  # what is left is the vein's outline and its name


def test_a_press_shorter_than_a_heartbeat_has_a_picture_of_its_own(session, scene):
    for k, stamp in enumerate(session.poses):
        session.poses[stamp] = Pose([0.0, 0.0, 0.012 if 20 <= k < 23 else 0.0])
    assert list(colour_pictures(session, scene)) == ["touched", "full press", "let go"]


def times_of_pictures(session, scene, *areas):
    """s, of the frames whose flow the three pictures show."""
    times = []
    original = ColourDoppler.estimate
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            ColourDoppler,
            "estimate",
            lambda self, blood, frame: times.append(frame.time) or original(self, blood, frame),
        )
        assert len(colour_pictures(session, scene, *areas)) == 3
    return times


def test_no_moment_is_of_a_probe_in_the_air(session, scene):
    """It touches and is let go for 0.2 s only, and then is lifted off."""
    air = Pose([0.0, 0.0, -0.01])
    for k, stamp in enumerate(session.poses):
        if not (11 <= k < 13 or 20 <= k < 62):
            session.poses[stamp] = air
    times = times_of_pictures(session, scene)
    depths = [session.poses[round(1e9 * time)].position[2] for time in times]
    assert min(depths) >= 0.0


def test_moments_are_of_images_that_show_the_vessel_whole(session, scene):
    """It is out of the image at first, at the deepest, and at the end."""
    deepest = min(session.poses) + int(2.5e9)
    session.poses[deepest] = Pose([0.0, 0.0, 0.02])
    times = np.arange(80) / 10
    rest = np.where((times < 1.4) | (abs(times - 2.5) < 0.2) | (times > 7.5), np.nan, 1e-5)
    areas = LumenAreas(times, np.zeros(80), {"vein": np.full(80, 1e-5)}, {"vein": rest})
    since = np.array(times_of_pictures(session, scene, areas)) - 1.0  # s
    assert ((since > 1.3) & (abs(since - 2.5) > 0.1) & (since < 7.6)).all()
    areas.at_rest["vein"][:] = np.nan
    assert colour_pictures(session, scene, areas) == {}


def test_there_are_none_of_a_scene_without_flows(session, small_scene):
    assert colour_pictures(session, load_scene(small_scene)) == {}


@pytest.fixture
def plain_scene(small_scene):
    return load_scene(small_scene)


def session_of(plain_scene, depths):
    mesh = tissue_model_of(plain_scene, volume_of(plain_scene)).mesh
    poses, nodes = {}, {}
    for k, depth in enumerate(depths):
        poses[k] = Pose([0.0, 0.0, depth])
        press = max(depth, 0.0)
        nodes[k] = mesh.nodes * [1, 1, 1 - press / 0.05] + [0, 0, press]
    return Session(None, poses, nodes, mesh.nodes, mesh.tetrahedra, {}, {})


def test_an_even_press_has_the_colour_of_its_strain_in_all_pictures(plain_scene):
    session = session_of(plain_scene, np.linspace(-1e-3, 5e-3, 61))
    pictures = strain_pictures(session, plain_scene)
    titles = ["strain since rest", "strain between two images", "estimate from these two images"]
    assert list(pictures) == titles
    for picture in pictures.values():
        assert picture.pixels.shape == (80, 96, 3)
    since_rest, between, estimate = pictures.values()
    assert estimate.stamps == between.stamps
    assert since_rest.stamps == between.stamps[1:]
    red, green, _ = since_rest.pixels[40, 60].astype(int)
    assert red > green + 60  # shortened, at the end of the scale


def test_without_a_press_or_tissue_there_are_none(plain_scene):
    assert strain_pictures(session_of(plain_scene, [-3e-3, -2e-3, -1e-3, 0.0]), plain_scene) == {}
    bare = session_of(plain_scene, [0.0, 1e-3, 2e-3])
    without = Session(None, bare.poses, bare.nodes, None, None, {}, {})
    assert strain_pictures(without, plain_scene) == {}
