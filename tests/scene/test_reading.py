"""Scene files: what they mean, and one sentence with file and key for each kind of mistake."""

import copy
import dataclasses

import liver_sweep
import numpy as np
import pytest
import yaml

from us_sim.errors import SceneError, UsSimError
from us_sim.geometry.collider import Sphere
from us_sim.scene.building import build_collider, build_probe
from us_sim.scene.reading import load_scene, parse_scene
from us_sim.scene.scene import ImagingSettings
from us_sim.share import shared_path
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.slicing.settings import StrainSettings
from us_sim.tissue.mesh.tetrahedral_mesh import MeshSettings
from us_sim.volume.sequences.sweep import read_sweep

COMPLETE = yaml.safe_load(
    """
name: test
volume: {phantom: upper_arm, seed: 3, voxel_size: 1 mm}
probe:
  aperture: 40 mm
  depth: 0.03
  image: [64, 48]
  collider: {shape: sphere, radius: 2 cm}
tissue:
  mesh: {lower: [-20 mm, -20 mm, 0], upper: [20 mm, 20 mm, 40 mm], nodes: [3, 4, 5]}
  materials: {muscle: {young_modulus: 12 kPa, poisson_ratio: 0.4}}
skin: {spacing: 5 mm}
"""
)


def changed(key: str, value: object) -> dict:
    """The complete scene with the value at a dotted key set (or, with None, removed)."""
    document = copy.deepcopy(COMPLETE)
    *parents, last = key.split(".")
    section = document
    for parent in parents:
        section = section[parent]
    if value is None:
        del section[last]
    else:
        section[last] = value
    return document


@pytest.mark.parametrize(
    ("key", "value", "fact"),
    [
        ("probe.aperture", 40, "my.yaml: probe.aperture: .*'40 mm'"),
        ("probe.image", [512, 1.5], r"my.yaml: probe.image\[1\]: 1.5"),
        ("probe.image", [4097, 5], r"my.yaml: probe.image\[0\]: 4097 .* 1 to 4096"),
        ("probe.geometry", "convex", "my.yaml: probe.aperture: "),
        ("probe.geometry", "sector", "my.yaml: probe.opening_angle: "),
        ("probe.collider", None, "my.yaml: probe.collider: "),
        ("probe.collider.shape", "capsule", "my.yaml: probe.collider.length: .*capsule"),
        ("probe.collider.width", 0.01, "my.yaml: probe.collider.width: .*sphere"),
        ("volume", None, "my.yaml: volume: "),
        ("volume", {}, "my.yaml: volume.file: .*--volume"),
        ("volume.file", "a.mha", "my.yaml: .*`file` and `phantom`"),
        ("volume", {"file": "nowhere.mha"}, "my.yaml: volume.file: .*nowhere.mha"),
        ("path", "nowhere.mcap", "my.yaml: path: .*nowhere.mcap"),
        ("skin.file", "nowhere.obj", "my.yaml: skin.file: .*nowhere.obj"),
        ("tissue.mesh.upper", [1, 1, -1], r"my.yaml: tissue.mesh.upper\[2\]: -1 m"),
        ("tissue.mesh.planes", {"x": [0, 0]}, "my.yaml: tissue.mesh.planes.x: .*rising"),
        ("tissue.mesh.planes", {"x": [-0.02, 0, 0.01]}, "planes.x: .*3 .* -0.02 to 0.02 m"),
        ("tissue.mesh.planes", {"w": [0, 1]}, "my.yaml: tissue.mesh.planes: .*`w`"),
        ("tissue.mesh.file", "liver.msh", "my.yaml: tissue.mesh: .*`file` and `lower`"),
        ("tissue.mesh", {"file": "liver.msh"}, "my.yaml: tissue.mesh.file: .*liver.msh"),
        ("tissue.mesh.unit", "1 mm", "my.yaml: .*`unit`, `pose` and `margin`"),
        ("structures", {"vein": {"colour": [1, 0, 2]}}, r"my.yaml: .*vein.colour\[2\]: 2 "),
        ("structures", {"a": {"file": "a", "label": "b"}}, "structures.a: .*`file` and `label`"),
        ("structures", {"a": {"unit": "1 mm"}}, "my.yaml: structures.a: .*`unit` and `pose`"),
        ("tissue.materials", {}, "my.yaml: tissue.materials: "),
        ("tissue.materials.muscle.poisson_ratio", 0.5, "materials.muscle.poisson_ratio: 0.5"),
    ],
)
def test_each_mistake_is_one_sentence_with_file_and_key(key, value, fact):
    with pytest.raises(SceneError, match=rf"\A(my.yaml: .*)?{fact}.*\Z"):
        parse_scene(changed(key, value), origin="my.yaml")


def test_structures_may_be_a_list_or_have_no_more_than_a_name():
    for given in (["vein", "artery"], {"vein": None, "artery": {}}):
        scene = parse_scene(changed("structures", given))
        assert list(scene.structures) == ["vein", "artery"]
        assert scene.structures["vein"].label is None
    assert parse_scene(COMPLETE).structures == {}


def test_structures_need_a_tissue():
    document = changed("tissue", None) | {"structures": ["vein"]}
    with pytest.raises(SceneError, match=r"my\.yaml: structures: .*`tissue`"):
        parse_scene(document, origin="my.yaml")


def scene_with_probe(**probe):
    document = copy.deepcopy(COMPLETE)
    del document["tissue"], document["skin"]
    document["probe"] = probe
    return parse_scene(document, origin="my.yaml")


def test_a_linear_probe_has_512_by_512_pixels_unless_told():
    probe = build_probe(scene_with_probe(aperture="4 cm", depth="3 cm", focus="2 cm", lines=128))
    assert isinstance(probe, LinearProbe)
    assert (probe.columns, probe.rows, probe.lines) == (512, 512, 128)
    assert (probe.aperture, probe.depth, probe.focus) == pytest.approx((0.04, 0.03, 0.02))
    square = build_probe(scene_with_probe(aperture="4 cm", depth="3 cm", image=300))
    assert (square.columns, square.rows) == (400, 300)


def test_fans_have_square_pixels_unless_told():
    convex = {"geometry": "convex", "radius": "60 mm", "opening_angle": "60 deg", "depth": "14 cm"}
    probe = build_probe(scene_with_probe(**convex))
    assert isinstance(probe, ConvexProbe)
    assert (probe.width, probe.rows) == pytest.approx((0.2, 512))
    assert probe.pixel_spacing[0] == pytest.approx(probe.pixel_spacing[1], rel=1e-3)
    probe = build_probe(scene_with_probe(**convex, image=[200, 100], samples=300))
    assert (probe.columns, probe.rows, probe.samples) == (200, 100, 300)
    sector = {"geometry": "sector", "opening_angle": "90°", "depth": "16 cm", "aperture": "2 cm"}
    probe = build_probe(scene_with_probe(**sector, radius="5 mm", image=400))
    assert isinstance(probe, SectorProbe)
    assert (probe.radius, probe.rows) == (0.005, 400)
    assert probe.width == pytest.approx(0.01 + 0.16 * 2**0.5)


@pytest.mark.parametrize(
    ("given", "fact"),
    [
        ({}, "aperture: "),
        ({"aperture": "1 cm", "radius": "1 cm"}, "aperture: 10 mm .* 20 mm"),
        ({"aperture": "2 cm", "image": 4096}, "image: .*5793"),
    ],
)
def test_a_probe_that_cannot_be_is_refused_when_the_scene_is_read(given, fact):
    sector = {"geometry": "sector", "opening_angle": "90 deg", "depth": "16 cm"}
    with pytest.raises(SceneError, match=f"my.yaml: probe.{fact}"):
        scene_with_probe(**sector, **given)


@pytest.mark.parametrize(
    ("content", "fact"),
    [
        (b"\xff\xfe\x00", ""),
        (b"name: test\nvolume: [1, 2\n", "line 3"),
        (b"", "empty"),
    ],
)
def test_a_broken_file_is_named_with_its_line(tmp_path, content, fact):
    file = tmp_path / "broken.yaml"
    file.write_bytes(content)
    with pytest.raises(SceneError, match=f"broken.yaml.*{fact}"):
        load_scene(file)


def test_the_installed_scenes_are_valid(tmp_path):
    volume = tmp_path / "volume.mha"
    volume.touch()
    assert load_scene("upper_arm").tissue is not None
    assert load_scene("liver_sweep", volume=volume).volume.file == str(volume)
    with pytest.raises(SceneError, match=r"volume\.file: "):
        load_scene("liver_sweep")
    for file in shared_path("config/scenes").glob("*.yaml"):
        load_scene(file, volume=volume)


def test_the_liver_scene_is_the_middle_frame_of_the_sweep_that_made_its_volume(shared_data):
    folder = shared_data / "imfusion-liver-sweep"
    scene = load_scene("liver_sweep", volume=folder / "liver_sweep_compounded_1mm.mha")
    recorded = liver_sweep.probe()
    probe = build_probe(scene)
    assert probe.radius == pytest.approx(recorded.radius, abs=1e-5)
    assert probe.depth == pytest.approx(recorded.depth, abs=1e-5)
    assert probe.opening_angle == pytest.approx(recorded.opening_angle, abs=1e-5)
    sweep = read_sweep(folder / "liver_sweep.igs.mha")
    middle = liver_sweep.probe_pose(sweep.image_to_reference[len(sweep.numbers) // 2])
    place = scene.volume.pose.pose @ middle
    np.testing.assert_allclose(place.matrix, np.eye(4), atol=2e-6)


def test_a_scene_says_only_what_differs_from_the_one_it_is_based_on(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "grip.yaml").write_text("markers: []")
    (tmp_path / "far" / "base.yaml").write_text(
        "based_on: upper_arm\ntracker: {source: camera, camera: {body: grip.yaml}}"
    )
    file = tmp_path / "mine.yaml"
    file.write_text("name: mine\nbased_on: far/base.yaml\nprobe: {depth: 3 cm}\nskin: null")
    scene, arm = load_scene(file), load_scene("upper_arm")
    assert (scene.name, scene.origin) == ("mine", str(file))
    assert build_probe(scene) == dataclasses.replace(build_probe(arm), depth=0.03)
    assert scene.probe.collider == arm.probe.collider
    assert scene.skin is None
    assert scene.tissue == arm.tissue
    assert scene.tracker.source.given.body == str(tmp_path / "far" / "grip.yaml")


def test_another_kind_of_probe_does_not_inherit_the_dimensions_of_the_base_s(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(
        "name: mine\nbased_on: upper_arm\nprobe: {geometry: convex, radius: 5 cm, "
        "opening_angle: 60 deg, collider: {shape: sphere, radius: 3 cm}}"
    )
    scene = load_scene(file)
    assert (build_probe(scene).radius, build_probe(scene).depth) == (0.05, 0.04)
    assert build_collider(scene) == Sphere(0.03)


TETRAHEDRON = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
TETRAHEDRON += "$Nodes\n4\n1 0 0 0\n2 90 0 0\n3 0 90 0\n4 0 0 90\n$EndNodes\n"
TETRAHEDRON += "$Elements\n1\n1 4 2 0 1 1 2 3 4\n$EndElements\n"


def based_on(base, says, folder):
    file = folder / "mine.yaml"
    file.write_text(f"name: mine\nbased_on: {base}\n{says}")
    return load_scene(file)


def test_a_file_takes_the_place_of_the_base_s_box_and_a_box_that_of_its_file(tmp_path):
    (tmp_path / "organ.msh").write_text(TETRAHEDRON)
    of_file = based_on("upper_arm", "tissue: {mesh: {file: organ.msh, unit: 1 mm}}", tmp_path)
    assert of_file.tissue.mesh == MeshSettings(file=str(tmp_path / "organ.msh"), unit=1e-3)
    assert of_file.tissue.materials == load_scene("upper_arm").tissue.materials
    (tmp_path / "mine.yaml").rename(tmp_path / "organ.yaml")
    box = "tissue: {mesh: {lower: [0, 0, 0], upper: [1 cm, 1 cm, 1 cm]}}"
    again = based_on("organ.yaml", box, tmp_path)
    assert again.tissue.mesh == MeshSettings(lower=(0, 0, 0), upper=(0.01, 0.01, 0.01))
    finer = based_on("upper_arm", "tissue: {mesh: {nodes: [20, 20, 10]}}", tmp_path)
    assert finer.tissue.mesh.nodes == (20, 20, 10)
    assert finer.tissue.mesh.lower == load_scene("upper_arm").tissue.mesh.lower


def test_a_volume_and_a_structure_of_a_file_take_the_place_of_the_base_s(tmp_path):
    for name in ("volume.mha", "vein.stl"):
        (tmp_path / name).touch()
    says = "volume: {file: volume.mha, pose: {position: [0, 0, 1 cm]}}\n"
    says += "structures: {wall: {label: skin}}"
    of_file = based_on("upper_arm", says, tmp_path)
    assert of_file.volume.file == str(tmp_path / "volume.mha")
    assert of_file.volume.phantom is None
    (tmp_path / "mine.yaml").rename(tmp_path / "base.yaml")
    says = "volume: {phantom: upper_arm}\nstructures: {wall: {file: vein.stl, unit: 1 mm}}"
    phantom = based_on("base.yaml", says, tmp_path)
    assert (phantom.volume.file, phantom.volume.pose) == (None, of_file.volume.pose)
    assert phantom.structures["wall"].label is None
    with pytest.raises(SceneError, match="`file` and `phantom`"):
        based_on("upper_arm", "volume: {file: volume.mha, phantom: upper_arm}", tmp_path)


def test_null_takes_back_what_the_base_says(tmp_path):
    says = "tissue: {materials: {vein: null, nerve: {density: 990}}, solver: null}\nimaging: null"
    scene, arm = based_on("upper_arm", says, tmp_path), load_scene("upper_arm")
    assert set(arm.tissue.materials) - set(scene.tissue.materials) == {"vein"}
    assert scene.tissue.materials["nerve"].density == 990
    assert (arm.tissue.solver, scene.tissue.solver) == ("fem_nonlinear", "fem")
    assert scene.imaging == ImagingSettings()
    with pytest.raises(SceneError, match="volume: "):
        based_on("upper_arm", "volume: null", tmp_path)


@pytest.mark.parametrize(
    ("base", "fact"),
    [
        ("other.yaml", "this scene itself"),
        ("nowhere", "nowhere"),
        ("bad.yaml", "bad.yaml"),
    ],
)
def test_a_base_that_cannot_be_is_refused(tmp_path, base, fact):
    (tmp_path / "other.yaml").write_text("based_on: mine.yaml")
    (tmp_path / "bad.yaml").write_text("{")
    with pytest.raises(SceneError, match=fact):
        based_on(base, "", tmp_path)


def test_strain_needs_tissue():
    bare = {
        "name": "bare",
        "volume": {"phantom": "upper_arm"},
        "probe": {"aperture": 0.04, "depth": 0.04},
    }
    assert parse_scene(bare | {"strain": {}}).strain == StrainSettings()
    with pytest.raises(SceneError, match=r"strain: .*`tissue`"):
        parse_scene(bare | {"strain": {"since": "image"}})
    with pytest.raises(UsSimError, match=r"strain\.interval: 0 .* 1 to 60"):
        parse_scene(bare | {"strain": {"interval": 0}})
