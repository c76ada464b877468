"""Pictures of a session's strain: from which images, and that they agree where they should."""

import numpy as np
import pytest

from us_sim.demo.contact_sheet import strain_pictures
from us_sim.demo.session import Session
from us_sim.geometry.pose import Pose
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import load_scene


@pytest.fixture
def scene(small_scene):
    return load_scene(small_scene)


def session_of(scene, depths):
    mesh = tissue_model_of(scene, volume_of(scene)).mesh
    poses, nodes = {}, {}
    for k, depth in enumerate(depths):
        poses[k] = Pose([0.0, 0.0, depth])
        press = max(depth, 0.0)
        nodes[k] = mesh.nodes * [1, 1, 1 - press / 0.05] + [0, 0, press]
    return Session(None, poses, nodes, mesh.nodes, mesh.tetrahedra, {}, {})


def test_an_even_press_has_the_colour_of_its_strain_in_all_pictures(scene):
    session = session_of(scene, np.linspace(-1e-3, 5e-3, 61))
    pictures = strain_pictures(session, scene)
    titles = ["strain since rest", "strain between two images", "estimate from these two images"]
    assert list(pictures) == titles
    for picture in pictures.values():
        assert picture.shape == (80, 96, 3)
    red, green, _ = pictures["strain since rest"][40, 60].astype(int)
    assert red > green + 60  # shortened, at the end of the scale


def test_without_a_press_or_tissue_there_are_none(scene):
    assert strain_pictures(session_of(scene, [-3e-3, -2e-3, -1e-3, 0.0]), scene) == {}
    bare = session_of(scene, [0.0, 1e-3, 2e-3])
    without = Session(None, bare.poses, bare.nodes, None, None, {}, {})
    assert strain_pictures(without, scene) == {}
