"""Sound along the current beams: laws that need no formula, and every sentence about wrong input.

Closed forms of loss and shadow are in tests/evaluation/image, those of borders and fibres here.
"""

import ast
import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from us_sim.errors import ProbeError, SceneError
from us_sim.geometry.pose import Pose
from us_sim.scene.reading import parse_scene
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.acoustics.surface_echo import (
    BLOCK,
    DISTANCE,
    MIRROR,
    ROUGHNESS,
    SurfaceNormals,
)
from us_sim.slicing.b_mode import BMode, measure_excess_depth
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe
from us_sim.slicing.settings import ECHO_RANGE, Imaging
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume

PROBE = LinearProbe(aperture=0.03, depth=0.03, columns=120, rows=120)
LIVE = Acoustics(artefacts="live", frequency=6e6, compensation=0.57)
NAMES = {1: "muscle", 2: "bone", 3: "vein"}


def ball(label, radius=4e-3, centre=(0.0, 0.0, 0.012)):
    """Muscle with a ball of something else: 0.5 mm voxels of one grey."""
    placed = np.diag([5e-4, 5e-4, 5e-4, 1.0])
    placed[:3, 3] = (-0.02, -0.01, -0.01)
    index = np.indices((81, 41, 101)).reshape(3, -1)
    points = placed[:3, :3] @ index + placed[:3, 3:]
    inside = np.linalg.norm(points - np.array(centre)[:, None], axis=0) < radius
    labels = np.where(inside, label, 1).astype(np.uint8).reshape(81, 41, 101)
    return Volume(np.full(labels.shape, 150, np.uint8), placed, labels, NAMES)


@pytest.mark.slow
def test_off_imports_nothing_and_changes_nothing():
    baked = BMode(ball(3), PROBE, acoustics=Acoustics()).render_image(Pose())
    np.testing.assert_array_equal(baked, BMode(ball(3), PROBE).render_image(Pose()))
    code = (
        "import sys; from us_sim.slicing.b_mode import BMode; "
        "from us_sim.slicing.acoustics.settings import Acoustics; "
        "print([m for m in sys.modules if m.startswith('us_sim.slicing.acoustics.')])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    room = "us_sim.slicing.acoustics"
    assert set(ast.literal_eval(said.stdout)) <= {f"{room}.settings"}


def test_behind_bone_is_dark_and_behind_blood_is_bright():
    plain = dataclasses.replace(LIVE, surfaces=False)
    beside = (slice(90, 110), slice(2, 12))
    behind = (slice(90, 110), slice(55, 65))
    bone = BMode(ball(2), PROBE, acoustics=plain).render_image(Pose())
    assert bone[behind].mean() < 40
    assert bone[beside].mean() == pytest.approx(150, abs=1)
    blood = BMode(ball(3), PROBE, acoustics=plain).render_image(Pose())
    assert blood[behind].mean() > blood[beside].mean() + 10
    assert blood[beside].mean() == pytest.approx(150, abs=1)


@pytest.mark.slow
def test_every_way_of_cutting_has_the_same_acoustics():
    mesh = box_mesh([-0.018, 0.0, 0.018], [-0.009, 0.009], [-0.008, 0.01, 0.035])
    pressed = mesh.nodes * [1.05, 1.0, 0.93]
    images = []
    for name in ("per_pixel", "scan_conversion"):
        scanner = BMode(ball(2), PROBE, acoustics=LIVE, method=name)
        scanner.attach_mesh(mesh.nodes, mesh.tetrahedra)
        images.append(scanner.render_image(Pose(), pressed).astype(int))
    assert np.percentile(np.abs(images[0] - images[1]), 99) <= 1


def test_the_same_image_comes_out_again_and_noise_differs_from_pose_to_pose():
    loud = BMode(ball(1), PROBE, acoustics=dataclasses.replace(LIVE, noise=-40.0))
    first = loud.render_image(Pose())
    np.testing.assert_array_equal(first, loud.render_image(Pose()))
    others = [loud.render_image(Pose(np.array([x, 0.0, 0.0]))) for x in (1e-4, 2e-4, 3e-4, 4e-4)]
    assert any((other != first).mean() > 0.2 for other in others)


def test_half_the_frequency_loses_half_the_level():
    plain = dataclasses.replace(LIVE, compensation=0.0, surfaces=False)
    low, high = (
        BMode(ball(1), PROBE, acoustics=dataclasses.replace(plain, frequency=f))
        .render_image(Pose())[60:100]
        .mean()
        for f in (4e6, 8e6)
    )
    assert (150.0 - low) / (150.0 - high) == pytest.approx(0.5, abs=0.01)


def test_a_frequency_below_the_volumes_own_blurs():
    low = dataclasses.replace(LIVE, frequency=4e6)
    blurred = dataclasses.replace(low, volume_frequency=8e6)
    sharp, soft = (
        BMode(ball(3), PROBE, acoustics=one).render_image(Pose()) for one in (low, blurred)
    )
    steps = [int(np.abs(np.diff(image.astype(int), axis=0)).max()) for image in (sharp, soft)]
    assert steps[1] < 0.7 * steps[0]


def layers(border, grey, names):
    """What lies above a border (m, along z) has label 1, what lies below has 2."""
    placed = np.diag([0.5e-3, 0.5e-3, 0.2e-3, 1.0])
    placed[:3, 3] = (-0.03, -0.02, -0.01)
    labels = np.ones((120, 80, 220), np.uint8)
    labels[:, :, placed[2, 3] + 0.2e-3 * np.arange(220) > border] = 2
    return Volume(np.full(labels.shape, grey, np.uint8), placed, labels, names)


def tilted(degrees, axis, y=0.0):
    """Turn a probe about x, out of its image's plane, or about y, in it."""
    turn = np.sin(np.radians(degrees) / 2) * np.array(axis)
    return Pose([0.0, y, 0.0], [*turn, np.cos(np.radians(degrees) / 2)])


@pytest.mark.slow
@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])
@pytest.mark.parametrize("degrees", [0.0, 10.0, 20.0])
def test_a_border_echoes_by_its_angle_as_facets_do(axis, degrees):
    tissues = {
        "above": TissueAcoustics(attenuation=0.57, impedance=1.5e6),
        "below": TissueAcoustics(attenuation=0.57, impedance=1.8e6),
    }
    sound = dataclasses.replace(LIVE, tissues=tissues, anisotropy=False)
    fine = PROBE.with_pixels(512, 512)
    scanner = BMode(layers(0.0121, 40, {1: "above", 2: "below"}), fine, acoustics=sound)
    # The border is patchy: the mean of its brightest pixels, over its grain.
    shown = [
        scanner.render_image(tilted(degrees, axis, y)).max(axis=0) for y in 5e-4 * np.arange(16)
    ]
    facets = np.exp(-(np.tan(np.radians(degrees)) ** 2) / (2 * ROUGHNESS**2))
    expected = MIRROR + 20.0 * np.log10(0.3 / 3.3 * facets)
    assert np.mean(shown) / GREYS_PER_DECIBEL - ECHO_RANGE == pytest.approx(expected, abs=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("shear", [0.0, 0.15])
@pytest.mark.parametrize("degrees", [0.0, 10.0, 20.0])
def test_fibres_are_brightest_across_the_beam(degrees, shear):
    fibres = {"fibres": (0.0, 1.0, 0.0), "anisotropy": 14.0, "half_angle": 0.3}
    muscle = TissueAcoustics(attenuation=0.57, impedance=1.645e6, **fibres)
    sound = dataclasses.replace(LIVE, tissues={"muscle": muscle}, surfaces=False)
    scanner = BMode(layers(1.0, 150, {1: "muscle"}), PROBE, acoustics=sound)
    carrier = box_mesh(*(np.linspace(*side, 4) for side in ((-0.02, 0.02),) * 2 + ((0.0, 0.033),)))
    scanner.attach_mesh(carrier.nodes, carrier.tetrahedra)
    nodes = carrier.nodes.copy()
    nodes[:, 2] += shear * nodes[:, 1]
    image = scanner.render_image(tilted(degrees, (1.0, 0.0, 0.0)), nodes)[30:90, 30:90]
    square = np.sin(np.radians(degrees) - np.arctan(shear)) ** 2
    expected = -14.0 * square / (square + np.sin(0.3) ** 2)
    assert (image.mean() - 150) / GREYS_PER_DECIBEL == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("flat", [0.35, 0.2])
def test_the_walls_of_a_crushed_vein_are_drawn_without_steps(flat):
    voxel, radius, middle = 2.5e-4, 4e-3, 0.0121
    x, _, z = np.indices((121, 9, 121)) * voxel
    labels = np.where(np.hypot(x - 0.0152, z - middle) < radius, 3, 1).astype(np.uint8)
    dark = Volume(np.zeros_like(labels), np.diag([voxel] * 3 + [1.0]), labels, NAMES)
    walls = {"vein": TissueAcoustics(reflection=-11.0)}
    probe = LinearProbe(aperture=0.024, depth=0.024, columns=320, rows=320)
    scanner = BMode(dark, probe, acoustics=dataclasses.replace(LIVE, frequency=12e6, tissues=walls))
    depths = np.linspace(-0.002, 0.028, 14)
    mesh = box_mesh(np.linspace(0.0, 0.03, 9), [0.0, 0.002], depths)
    scanner.attach_mesh(mesh.nodes, mesh.tetrahedra)
    # Layers of tetrahedra that the vein lies in are crushed, others are not; all slope.
    crushed = (depths[1:] > middle - radius) & (depths[:-1] < middle + radius)
    heights = np.concatenate([[0.0], np.cumsum(np.diff(depths) * np.where(crushed, flat, 1.0))])

    def pressed(x, z):
        return np.interp(z, depths, depths[0] + heights) + 0.15 * (x - 0.0152)

    nodes = mesh.nodes.copy()
    nodes[:, 2] = pressed(nodes[:, 0], nodes[:, 2])
    image = scanner.render_image(Pose([0.0152, 0.001, 0.0]), nodes).astype(float)
    pixel = probe.depth / probe.rows
    column, row = np.arange(120, 200), np.arange(probe.rows)[:, None]
    x = 0.0152 + (column + 0.5) * pixel - 0.012
    for side in (-1, 1):
        z = middle + side * np.sqrt(radius**2 - (x - 0.0152) ** 2)
        wall = pressed(x, z) / pixel - 0.5  # row
        level = image[:, column] * (side * (row - wall) > -5.0) * (abs(row - wall) < 8.0)
        weight = level**4
        off = (weight * (row - wall)).sum(axis=0) / weight.sum(axis=0)
        assert np.sqrt(np.mean(off**2)) < 0.2
        assert np.abs(np.diff(off)).max() < 0.3


def normal_at(found, voxel):
    block = found.blocks[tuple(voxel // BLOCK)]
    within = np.ravel_multi_index(voxel % BLOCK, (BLOCK,) * 3)
    *normal, distance = found.normals[block, within] if block >= 0 else (0, 0, 0, 0)
    return np.array(normal) / 127, distance / DISTANCE


@pytest.mark.parametrize("radius", [5.0, 8.0])
def test_normals_of_a_ball_of_voxels_point_to_its_middle(radius):
    labels = (np.linalg.norm(np.indices((32, 32, 32)) - 15.3, axis=0) < radius).astype(np.uint8)
    labels.flags.writeable = False  # as those of a volume
    found = SurfaceNormals(labels)
    angles, distances = [], []
    for voxel in np.argwhere(labels):
        normal, distance = normal_at(found, voxel)
        if normal.any():
            place = voxel - 15.3
            away = np.linalg.norm(place)
            angles.append(np.degrees(np.arccos(np.clip(-normal @ place / away, -1.0, 1.0))))
            distances.append(radius - away - distance)
    assert len(angles) > 100
    assert np.percentile(angles, 95) < 6.0
    assert abs(np.median(distances)) < 0.5  # a curved surface seems to be a little nearer


@pytest.mark.parametrize(
    ("acoustics", "sentence"),
    [
        (
            {"frequency": 20e6},
            "imaging.acoustics.frequency: 20 MHz is not one that this probe has, which are 4 to 16",
        ),
        (
            {"tissues": {"liver": TissueAcoustics()}},
            r"imaging.acoustics.tissues.liver: .* 'liver'",
        ),
    ],
)
def test_what_does_not_go_with_probe_and_volume_is_said(acoustics, sentence):
    with pytest.raises(ProbeError, match=sentence):
        BMode(ball(2), PROBE, acoustics=dataclasses.replace(LIVE, **acoustics))


def test_a_volume_without_labels_is_refused_and_a_bad_change_keeps_what_was():
    bare = dataclasses.replace(ball(2), labels=None, label_names={})
    with pytest.raises(ProbeError, match=r"artefacts: `live`"):
        BMode(bare, PROBE, acoustics=LIVE)
    scanner = BMode(ball(2), PROBE, acoustics=LIVE)
    before = scanner.render_image(Pose())
    with pytest.raises(ProbeError):
        scanner.apply_settings(PROBE, Imaging(), dataclasses.replace(LIVE, frequency=40e6))
    np.testing.assert_array_equal(scanner.render_image(Pose()), before)


SCENE = {
    "name": "arm",
    "volume": {"phantom": "upper_arm", "voxel_size": "2 mm"},
    "probe": {"aperture": "4 cm", "depth": "3 cm", "image": [40, 30]},
}


@pytest.mark.parametrize(
    ("imaging", "sentence"),
    [
        ({"frequency": "30 MHz"}, "scene: imaging.acoustics.frequency: 30 MHz is not one that"),
        ({"tissues": {"skin": {"attenuation": "3 dB"}}}, "tissues.skin.attenuation: '3 dB' is not"),
        ({"tissues": {"skin": {"impedance": -1}}}, "tissues.skin.impedance: -1 Rayl is outside"),
        ({"tissues": {"skin": {"fibres": [0, 0, 0]}}}, "tissues.skin.fibres: 0, 0, 0 is no"),
        ({"tissues": {"skin": {"colour": 3}}}, "tissues.skin.colour: unknown key"),
    ],
)
def test_a_scene_with_wrong_acoustics_is_refused_with_its_key(imaging, sentence):
    with pytest.raises(SceneError, match=sentence):
        parse_scene({**SCENE, "imaging": {"acoustics": {"artefacts": "live", **imaging}}})


def test_an_image_that_is_deeper_than_a_box_says_by_how_much():
    box = np.array([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.05]])
    deep = ConvexProbe(radius=0.05, opening_angle=1.0, depth=0.08)
    assert measure_excess_depth(deep, Pose(), box) == pytest.approx(0.03)
    assert measure_excess_depth(PROBE, Pose(), box) == 0.0
    pressed = Pose(np.array([0.0, 0.0, 0.01]))
    assert measure_excess_depth(deep, pressed, box) == pytest.approx(0.04)
    assert measure_excess_depth(deep, pressed, box, pressed=False) == pytest.approx(0.03)
    lifted = Pose(np.array([0.0, 0.0, -0.01]))
    assert measure_excess_depth(deep, lifted, box, pressed=False) == pytest.approx(0.02)
    assert (
        measure_excess_depth(deep, Pose(np.array([0.0, 0.0, -0.2])), box) == 0.0
    )  # in the air above it
    half = np.radians(30) / 2
    turned = Pose(np.zeros(3), np.array([0.0, np.sin(half), 0.0, np.cos(half)]))
    assert measure_excess_depth(deep, turned, box) == pytest.approx(
        0.08 - 0.05 / np.cos(np.radians(30))
    )
    # 45° towards the box from beside it: the beam leaves the box's layer of depth before its side.
    across = Pose(np.array([-0.08, 0.0, 0.03]), [0.0, np.sin(np.pi / 8), 0.0, np.cos(np.pi / 8)])
    assert (
        measure_excess_depth(deep, across, np.array([[-0.05, -0.05, 0.0], [0.05, 0.05, 0.05]]))
        == 0.0
    )
