"""Pictures of a session's flow: which moments they are of, and that a closed vein shows none."""

import numpy as np
import pytest
import yaml

from us_sim.demo.colour_pictures import colour_pictures
from us_sim.demo.session import Session
from us_sim.geometry.pose import Pose
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import load_scene

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


def test_there_are_none_of_a_scene_without_flows(session, small_scene):
    assert colour_pictures(session, load_scene(small_scene)) == {}
