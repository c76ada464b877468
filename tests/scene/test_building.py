"""Structures of a scene: from labels and from files, in a box and in an organ's own mesh.

A scene's flows: blood in its vessels, and a sentence for what cannot flow.
"""

import shutil

import numpy as np
import pytest
import yaml
from old_gmsh import as_vtu

from us_sim.errors import MeshError, SceneError
from us_sim.scene.building import (
    build_blood,
    build_structures,
    build_tissue_model,
    load_volume,
    require_labels,
)
from us_sim.scene.reading import load_scene, parse_scene
from us_sim.tissue.model import face_nodes

DOCUMENT = {
    "name": "cylinder",
    "volume": {"phantom": "upper_arm", "seed": 1, "voxel_size": "1 mm"},
    "probe": {
        "aperture": "40 mm",
        "depth": "40 mm",
        "collider": {"shape": "sphere", "radius": "20 mm"},
    },
    "tissue": {
        # 35.6 long, 7.6 across: laid into the arm, across the middle of the block.
        "mesh": {
            "file": "truthcylinder1.vtu",
            "unit": "1.5 mm",
            "pose": {"position": [0, "15 mm", "20 mm"]},
            "margin": "3 mm",
        },
        "fixed": ["bottom"],
        "materials": {
            name: {"young_modulus": "10 kPa"}
            for name in ("skin", "fat", "muscle", "bone", "artery", "vein", "nerve")
        },
    },
    "structures": {"vein": None, "vessel": {"label": "artery", "colour": [0.5, 0.25, 0.75]}},
}


@pytest.fixture(scope="module")
def folder(shared_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("organs")
    as_vtu(shared_data / "meshes-sofa" / "truthcylinder1.msh", folder)
    shutil.copy(shared_data / "meshes-sofa" / "liver.vtk", folder)
    return folder


@pytest.fixture(scope="module")
def organ(folder):
    return parse_scene(DOCUMENT, folders=[folder])


def test_a_mesh_from_a_file_takes_the_place_of_the_box(organ):
    notes = []
    model = build_tissue_model(organ, load_volume(organ), notes.append)
    assert len(model.mesh.tetrahedra) == 2524
    held = int(model.fixed.sum())
    assert notes == [f"tissue mesh: fixed: `bottom` holds {held} of 642 nodes"]
    assert np.ptp(model.mesh.nodes[:, 1]) == pytest.approx(1.5e-3 * 35.56, rel=0.01)
    np.testing.assert_array_equal(
        np.flatnonzero(model.fixed), face_nodes(model.mesh, "bottom", 0.003)
    )
    assert not model.fixed[model.contact_nodes].any()
    assert model.mesh.nodes[model.contact_nodes, 2].mean() < model.mesh.nodes[:, 2].mean()


def test_structures_end_where_an_organ_ends(organ):
    volume = load_volume(organ)
    mesh = build_tissue_model(organ, volume).mesh
    made = {one.name: one for one in build_structures(organ, volume, mesh, 20_000)}
    assert list(made) == ["vein", "vessel"]
    assert made["vessel"].colour == (0.5, 0.25, 0.75)
    for one in made.values():
        surface = one.surface
        reach = 0.5 * np.linalg.norm(np.ptp(mesh.nodes[mesh.tetrahedra], axis=1), axis=1).max()
        assert (surface.vertices > mesh.nodes.min(axis=0) - reach).all()
        assert (surface.vertices < mesh.nodes.max(axis=0) + reach).all()
        np.testing.assert_array_equal(surface.deform_vertices(mesh.nodes), surface.vertices)


def test_a_surface_from_a_file_is_placed_in_its_unit_and_pose(small_scene, tmp_path):
    (tmp_path / "tile.obj").write_text("v -5 0 0\nv 5 0 0\nv 0 8 0\nf 1 2 3\n")
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        small_scene.read_text() + "structures:\n"
        "  tile:\n    file: tile.obj\n    unit: 1 mm\n"
        "    pose: {position: [0, 0, 20 mm]}\n"
    )
    placed = load_scene(scene)
    volume = load_volume(placed)
    (tile,) = build_structures(placed, volume, build_tissue_model(placed, volume).mesh, 100)
    expected = np.array([[-0.005, 0, 0.02], [0, 0.008, 0.02], [0.005, 0, 0.02]])
    order = np.lexsort(tile.surface.vertices.T[::-1])
    np.testing.assert_allclose(tile.surface.vertices[order], expected, atol=1e-9)


def test_labels_that_are_not_there_are_named(organ):
    volume = load_volume(organ)
    unknown = parse_scene(
        DOCUMENT
        | {
            "tissue": DOCUMENT["tissue"] | {"mesh": {"lower": [0, 0, 0], "upper": [1, 1, 1]}},
            "structures": {"stone": {"label": "kidney"}},
        },
        origin="my.yaml",
    )
    with pytest.raises(SceneError, match=r"my.yaml: structures.stone.label: .*`kidney`.*skin, "):
        require_labels(unknown, volume.label_names)


def test_a_mesh_in_the_wrong_unit_or_of_a_surface_is_refused(organ, folder):
    def scene(mesh):
        tissue = DOCUMENT["tissue"] | {"mesh": mesh}
        return parse_scene(DOCUMENT | {"tissue": tissue}, folders=[folder])

    with pytest.raises(MeshError, match=r"truthcylinder1\.vtu: .*35\.6 m"):
        build_tissue_model(scene({"file": "truthcylinder1.vtu"}), load_volume(organ))
    with pytest.raises(MeshError, match=r"liver\.vtk: .*tetrahedral"):
        build_tissue_model(scene({"file": "liver.vtk"}), load_volume(organ))


FLOW = {"kind": "venous", "direction": [0, -1, 0], "peak_velocity": 0.2, "mean_velocity": 0.07}


@pytest.fixture
def scene_with(tmp_path, small_scene):
    """The small scene with keys of its own."""

    def scene(**keys):
        file = tmp_path / "flow.yaml"
        file.write_text(yaml.safe_dump({"based_on": str(small_scene), **keys}))
        return load_scene(file)

    return scene


def test_the_arm_has_blood_in_its_vein_and_its_artery():
    scene = load_scene("upper_arm")
    blood = build_blood(scene, load_volume(scene))
    assert [vessel.name for vessel in blood.vessels] == ["structures.vein", "structures.artery"]
    vein, artery = blood.vessels
    # The phantom's own radii, which its seed changes by up to 4 %.
    assert vein.areas.mean() == pytest.approx(3.1416 * 3.5e-3 * 2.75e-3, rel=0.1)
    assert artery.areas.mean() == pytest.approx(3.1416 * 2.25e-3**2, rel=0.1)
    # Levenson, Peronneau, Simon and Safar (1981): 85 ml a minute through a brachial artery.
    assert artery.flow * 60e6 == pytest.approx(85, rel=0.1)


def test_a_flow_of_another_label_than_its_structures_name(scene_with):
    scene = scene_with(structures={"deep": {"label": "artery", "flow": FLOW}})
    assert list(scene.flows) == ["deep"]
    assert build_blood(scene, load_volume(scene)).vessels[0].areas.mean() < 3e-5
    assert "with blood in deep" in scene.list_parts()[3].reason


@pytest.mark.parametrize(
    ("name", "own", "fact"),
    [
        ("muscle", {}, r"muscle\.flow: .*tube"),
        ("vein", {"direction": [1, 0, 0]}, r"vein\.flow\.direction: \[1\.0, 0\.0, 0\.0\]"),
    ],
)
def test_what_cannot_flow_is_refused_with_file_key_and_reason(scene_with, name, own, fact):
    scene = scene_with(structures={name: {"flow": FLOW | own}})
    with pytest.raises(SceneError, match=rf"^{scene.origin}: structures\.{fact}"):
        build_blood(scene, load_volume(scene))


@pytest.mark.parametrize(
    ("keys", "fact"),
    [
        ({"structures": {"vein": {"file": "vein.stl", "flow": FLOW}}}, r"vein\.flow: .*label"),
    ],
)
def test_settings_that_cannot_be_are_refused_with_file_and_key(scene_with, tmp_path, keys, fact):
    (tmp_path / "vein.stl").write_text("")
    with pytest.raises(SceneError, match=rf"flow\.yaml: .*{fact}"):
        scene_with(**keys)
