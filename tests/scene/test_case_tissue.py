"""A scene from a case alone, and one that says other things than its case."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from us_sim.errors import SceneError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.geometry.transducer import ProbeSettings
from us_sim.scene.building import (
    build_scanner,
    build_structures,
    build_tissue_model,
    load_path,
    load_volume,
    structure_colour,
)
from us_sim.scene.case_tissue import cache_tissue
from us_sim.scene.reading import check_files, load_scene
from us_sim.scoring.exercise import read_exercise
from us_sim.scoring.live import LiveScan
from us_sim.settings.reading import SettingsReader
from us_sim.tissue.solvers.solver import create_solver
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.writing import write_labels, write_volume
from us_sim.volume.volume import Volume

TURN = (0.5, 0.5, 0.5, 0.5)
"""The probe's x, y and z along the volume's y, z and x."""


def block(clot: int = 6) -> Volume:
    """50 mm deep along x, 80 mm along y, 60 mm along z; a vein along z under the middle.

    Args:
        clot: the label of the vein's middle.
    """
    grid = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    grid[:3, 3] = [1e-3, -39e-3, -29e-3]
    grey = np.random.default_rng(1).integers(60, 120, (25, 40, 30), dtype=np.uint8)
    labels = np.zeros_like(grey)
    labels[8:11, 18:22, :] = 6
    labels[8:11, 18:22, 10:20] = clot
    labels[22:, :, :] = 2
    grey[labels == 6] = 10
    return Volume(grey, grid, labels)


@pytest.fixture(scope="module")
def cases(tmp_path_factory) -> Path:
    """A folder with the case `block`."""
    probe = {"aperture": "30 mm", "depth": "40 mm", "image": [150, 200]}
    structures = {"vein": CaseStructure(6), "rib": CaseStructure(2)}
    settings = CaseSettings(
        "block",
        probe=SettingsReader("probe").read(ProbeSettings, probe),
        start=CaseStart((0.0, 0.0, 0.0), TURN),
        structures=structures,
        press=7e-3,
        nodes=1000,
    )
    root = tmp_path_factory.mktemp("cases")
    with new_case(root / "block") as folder:
        write_volume(folder / "volume.nrrd", block())
        write_labels(folder / "labels.nrrd", block())
        write_case_settings(folder, settings)
    return root


@pytest.fixture(autouse=True)
def root(cases, monkeypatch, tmp_path):
    monkeypatch.setenv("US_SIM_CASES", str(cases))
    monkeypatch.chdir(tmp_path)


def test_a_case_alone_is_a_whole_scene(cases):
    scene = load_scene("case:block")
    assert scene.origin == f"case:{cases / 'block'}"
    assert [part.node for part in scene.list_parts() if part.needed] == [
        "probe_tracker",
        "tissue_deformer",
        "slice_interpolator",
    ]
    volume = load_volume(scene)
    # The probe's z is the volume's x: the vein, 16 to 22 mm deep there, is so in `patient`.
    centre = volume.patient_to_index @ [0.0, 0.0, 0.019, 1.0]
    assert volume.labels[tuple(np.rint(centre[:3]).astype(int))] == 6
    path = load_path(scene, Path(scene.path))
    assert path.positions[:, 2].max() == pytest.approx(7e-3)
    assert scene.tissue.fixed == ("bottom", "rib")
    assert scene.tissue.materials["vein"].lumen_pressure == 1e3
    assert structure_colour(scene, "vein") == (0.25, 0.4, 0.85)


@pytest.mark.slow
def test_a_thrombus_in_a_cases_vein_keeps_it_open_and_an_exercise_knows_of_it(tmp_path):
    """A structure of a case that is called after its vein is a thrombus, with no word more."""
    numbers = {"vein": 6, "vein thrombus": 8, "rib": 2}
    for name, volume in (("clot", block(8)), ("free", block())):
        probe = SettingsReader("probe").read(ProbeSettings, {"aperture": "30 mm", "depth": "40 mm"})
        settings = CaseSettings(
            name,
            probe=probe,
            start=CaseStart((0.0, 0.0, 0.0), TURN),
            structures={k: CaseStructure(n) for k, n in numbers.items() if n in volume.labels},
            nodes=600,
        )
        with new_case(tmp_path / name) as folder:
            write_volume(folder / "volume.nrrd", volume)
            write_labels(folder / "labels.nrrd", volume)
            write_case_settings(folder, settings)
    (tmp_path / "e.yaml").write_text("name: e\ntask: {kind: compression, points: 1}\n")
    exercise = read_exercise(tmp_path / "e.yaml")
    seen = {}
    for name in ("clot", "free"):
        scene = load_scene(f"case:{tmp_path / name}")
        volume = load_volume(scene)
        model = build_tissue_model(scene, volume)
        solver = create_solver("fem", model)
        scanner = build_scanner(scene, volume)
        scanner.attach_mesh(model.mesh.nodes, model.mesh.tetrahedra)
        live = LiveScan(volume, build_scanner(scene, volume), exercise)
        for k, depth in enumerate((0.0, 0.001, 0.001, 0.006, 0.012, 0.018, 0.001)):
            pose = Pose([0.0, 0.0, depth])
            nodes = solver.deform(pose).nodes
            live.add_pose(float(k), pose)
            live.add_force(float(k), np.array([0.0, 0.0, -1e3 * depth]))
            live.add_labels(float(k), pose, scanner.render_labels(pose, nodes))
        score = live.compute_score()
        (step,) = score.steps
        metrics = {each.name: each.value for each in score.metrics}
        least = metrics["Smallest Part of the Area at Rest"]
        seen[name] = least, step.is_done
    assert seen["clot"][0] > 80 > 60 > seen["free"][0]  # %, of linear tissue with few nodes
    assert (seen["clot"][1], seen["free"][1]) == (True, False)  # pressed by 18 N


def test_its_tissue_has_the_structures_materials_and_what_is_held():
    scene = load_scene("case:block")
    volume = load_volume(scene)
    model = build_tissue_model(scene, volume)
    assert len(model.mesh.nodes) <= 1000
    low, high = model.mesh.nodes.min(axis=0), model.mesh.nodes.max(axis=0)
    # As wide as the volume or the probe with what is beside it; as deep as the image is.
    np.testing.assert_allclose(low, [-31e-3, -30e-3, 0.0], atol=1e-9)
    np.testing.assert_allclose(high, [31e-3, 30e-3, 42e-3], atol=1e-9)
    vein = model.materials.lumen_fraction @ model.mesh.volumes
    assert vein == pytest.approx(6e-3 * 8e-3 * 60e-3, rel=0.05)
    assert model.fixed[model.mesh.nodes[:, 2] > 41e-3].all()
    (vein,) = build_structures(scene, volume, model.mesh, 2000)  # the rib is below the tissue
    assert (vein.name, vein.colour) == ("vein", (0.25, 0.4, 0.85))


def test_planes_lie_close_where_the_vein_is():
    scene = load_scene("case:block")
    x, _, z = build_tissue_model(scene, load_volume(scene)).mesh.planes
    steps, middle = np.diff(z), (z[1:] + z[:-1]) / 2
    in_vein = (middle > 16e-3) & (middle < 22e-3)
    assert in_vein.sum() >= 2
    assert steps[in_vein].max() < 0.5 * steps.max()
    assert np.diff(x)[np.abs((x[1:] + x[:-1]) / 2) < 4e-3].max() < 0.6 * np.diff(x).max()


@pytest.mark.slow
def test_tissue_is_made_once_and_made_anew_when_what_it_is_made_from_changes(
    cases, tmp_path, monkeypatch
):
    shutil.copytree(cases / "block", tmp_path / "block")
    cache = tmp_path / "cache"
    monkeypatch.setenv("US_SIM_CACHE", str(cache))
    scene = load_scene(f"case:{tmp_path / 'block'}")
    volume = load_volume(scene)
    before = build_tissue_model(scene, volume)
    (entry,) = cache.glob("tissue-*/")
    written = entry.stat().st_mtime_ns
    cache_tissue(scene, volume)
    again = build_tissue_model(scene, volume)
    assert entry.stat().st_mtime_ns == written
    np.testing.assert_array_equal(again.mesh.nodes, before.mesh.nodes)
    np.testing.assert_array_equal(again.materials.young_modulus, before.materials.young_modulus)
    case = tmp_path / "block" / "case.yaml"
    case.write_text(case.read_text().replace("nodes: 1000", "nodes: 1500"))
    finer = load_scene(f"case:{tmp_path / 'block'}")
    assert 1000 < len(build_tissue_model(finer, volume).mesh.nodes) <= 1500
    assert len(list(cache.glob("tissue-*/"))) == 2


def scene_file(folder, text):
    file = folder / "my.yaml"
    file.write_text(text)
    return file


def test_a_scene_says_what_it_wants_and_takes_the_rest_from_its_case(tmp_path):
    file = scene_file(
        tmp_path,
        "name: mine\ncase: block\nstructures: [vein]\nprobe: {depth: 3 cm}\n"
        "tissue: {solver: fem, materials: {vein: {young_modulus: 8 kPa}}}\n",
    )
    scene = load_scene(file)
    assert (scene.name, scene.tissue.solver) == ("mine", "fem")
    assert scene.tissue.materials["vein"].young_modulus == 8e3
    assert scene.tissue.materials["vein"].poisson_ratio == 0.1
    assert list(scene.structures) == ["vein"]
    assert scene.probe.array.given.depth == 0.03
    assert scene.probe.array.given.aperture == 0.03


def test_a_case_is_named_by_a_path_beside_the_scene(tmp_path, cases, monkeypatch):
    monkeypatch.setenv("US_SIM_CASES", str(tmp_path / "none"))
    (tmp_path / "here").mkdir()
    shutil.copytree(cases / "block", tmp_path / "here" / "mine")
    assert load_scene(scene_file(tmp_path / "here", "case: mine\n")).name == "block"


def test_a_volume_and_a_tissue_of_its_own_may_take_a_cases_volume(tmp_path, cases):
    file = scene_file(
        tmp_path, "name: bare\nvolume: {case: block}\nprobe: {aperture: 3 cm, depth: 4 cm}\n"
    )
    scene = load_scene(file)
    assert scene.volume.case == str(cases / "block")
    assert load_volume(scene).labels is not None
    assert scene.volume.name == "case block"


def test_label_0_without_a_material_is_said_to_be_the_tissue_between_structures(tmp_path):
    file = scene_file(
        tmp_path,
        "name: bare\nvolume: {case: block}\nprobe: {aperture: 3 cm, depth: 4 cm, collider: "
        "{shape: sphere, radius: 2 cm}}\ntissue: {mesh: {lower: [-2 cm, -2 cm, 0], upper: [2 cm, "
        "2 cm, 4 cm], nodes: [4, 4, 4]}, materials: {vein: {young_modulus: 8 kPa}}}\n",
    )
    with pytest.raises(SceneError, match="label 0, the tissue between structures"):
        check_files(load_scene(file))


PROBE = "probe: {depth: 4 cm, aperture: 3 cm}\n"


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("case: blok\n", "blok.*block"),
        ("case: ../../../../etc\n", "etc"),
        (f"name: a\nvolume: {{case: block, phantom: upper_arm}}\n{PROBE}", "`case` and `phantom`"),
        ("case: block\ntissue: {mesh: {nodes: 10}}\n", "10 .*64"),
        ("case: block\ntissue: {mesh: {planes: {x: [0, 1]}}}\n", "three numbers"),
    ],
)
def test_wrong_cases_are_refused_in_a_sentence_that_names_the_scene(tmp_path, text, fact):
    def build(file):
        scene = load_scene(file)
        build_tissue_model(scene, load_volume(scene))

    file = scene_file(tmp_path, text)
    with pytest.raises(UsSimError, match=f"{file}.*{fact}"):
        build(file)


def test_a_case_that_is_broken_is_said_with_the_file_that_is(tmp_path, cases):
    shutil.copytree(cases / "block", tmp_path / "broken")
    (tmp_path / "broken" / "case.yaml").write_text("name: a\nprobes: 3\n")
    with pytest.raises(SceneError, match=r"broken/case\.yaml: probes: "):
        load_scene(f"case:{tmp_path / 'broken'}")
    os.symlink(tmp_path / "loop", tmp_path / "loop")
    with pytest.raises(SceneError, match="loop"):
        load_scene(f"case:{tmp_path / 'loop'}")
