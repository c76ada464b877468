"""Files that a scene names are looked into before anything runs."""

import numpy as np
import pytest
import SimpleITK

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.run.plan import prepare_scene
from us_sim.scene.reading import check_files, load_scene, parse_scene
from us_sim.share import shared_path
from us_sim.tracking.calibration.transform_file import write_transform
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume

TETRAHEDRON = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
TETRAHEDRON += "$Nodes\n4\n1 0 0 0\n2 50 0 0\n3 0 50 0\n4 0 0 50\n$EndNodes\n"
TETRAHEDRON += "$Elements\n1\n1 4 2 0 1 1 2 3 4\n$EndElements\n"


@pytest.fixture
def document(tmp_path):
    """A scene with every file that one may name; each can be read."""
    image = SimpleITK.GetImageFromArray(np.zeros((4, 5, 6), dtype=np.uint8))
    SimpleITK.WriteImage(image, str(tmp_path / "volume.mha"))
    (tmp_path / "tissue.msh").write_text(TETRAHEDRON)
    (tmp_path / "skin.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "vessel.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for name, *frames in (("registration", "tracker", "patient"), ("calibration", "probe", "body")):
        write_transform(
            tmp_path / f"{name}.yaml",
            Pose(),
            from_frame=frames[0],
            to_frame=frames[1],
            method="landmarks",
        )
    (tmp_path / "body.yaml").write_text(
        "dictionary: ARUCO_ORIGINAL\nmarkers:\n"
        "  - {id: 1, size: 40 mm, position: [0, 0, 0], orientation: [0, 0, 0, 1]}\n"
    )
    names = {name: str(tmp_path / name) for name in (p.name for p in tmp_path.iterdir())}
    return {
        "name": "of_files",
        "volume": {"file": names["volume.mha"]},
        "probe": {"aperture": 0.04, "depth": 0.03, "collider": {"shape": "sphere", "radius": 0.02}},
        "tissue": {
            "solver": "fem",
            "mesh": {"file": names["tissue.msh"], "unit": "1 mm"},
            "fixed": ["bottom"],
            "materials": {
                "tissue": {"young_modulus": 1e4, "poisson_ratio": 0.4, "density": 1000.0}
            },
        },
        "skin": {"file": names["skin.obj"]},
        "structures": {"vessel": {"file": names["vessel.obj"]}},
        "tracker": {
            "source": "camera",
            "registration": names["registration.yaml"],
            "calibration": names["calibration.yaml"],
            "camera": {"body": names["body.yaml"]},
        },
        "path": str(shared_path("bags/press_and_slide.mcap")),
    }


@pytest.mark.parametrize(
    "name",
    [
        *("volume.mha", "tissue.msh", "skin.obj", "vessel.obj"),
        *("registration.yaml", "calibration.yaml", "body.yaml"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(document, tmp_path, name):
    (tmp_path / name).write_text("this: is [not", encoding="utf-8")
    with pytest.raises(UsSimError, match=name):
        check_files(parse_scene(document))


def test_a_recording_in_place_of_a_tracker_is_read_too(tmp_path):
    scene = load_scene("upper_arm_path")
    assert check_files(scene) == ["tracker.file", "path"]
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no recording")
    file = tmp_path / "scene.yaml"
    file.write_text("based_on: upper_arm_path\ntracker: {file: broken.mcap}\n", encoding="utf-8")
    with pytest.raises(UsSimError, match=r"broken\.mcap"):
        check_files(load_scene(file))


NOWHERE = "tissue: null\nimaging: null\nskin: null\nstructures: null\nvolume: {{file: grey.mha}}\n"
FLOW = "{{kind: venous, direction: [0, 1, 0], peak_velocity: 0.3, mean_velocity: 0.1}}"


@pytest.mark.parametrize(
    ("more", "found"),
    [
        ("structures: {{kidney: {{}}}}", r"structures\.kidney: the volume has no label `kidney`"),
        (f"structures: {{{{kidney: {{{{flow: {FLOW}}}}}}}}}", r"structures\.kidney: "),
        ("structures: {{a: {{label: kidney}}}}", r"structures\.a\.label: .*`kidney`"),
        ("tissue: {{materials: {{kidney: {{young_modulus: 1e4}}}}}}", r"tissue\.materials\.kidney"),
        ("tissue: {{fixed: [bottom, kidney]}}", r"tissue\.fixed\[1\]: .*`kidney`"),
        (
            "imaging: {{acoustics: {{tissues: {{kidney: {{fibres: [0, 1, 0]}}}}}}}}",
            r"tissues\.kidney: ",
        ),
        ("episode: {{target: kidney}}", r"episode\.target: .*kidney"),
        ("exercise: {}/kidney.yaml", r"exercise: .*kidney\.yaml is with kidney, which"),
        ("exercise: {}/bone.yaml", r"exercise: .*bone\.yaml is with bone, which is no vessel"),
        (f"{NOWHERE}exercise: {{}}/kidney.yaml", "exercise: .* is with kidney, .* has none"),
        (f"{NOWHERE}episode: {{{{target: kidney}}}}", r"episode\.target: .*kidney"),
    ],
)
def test_a_structure_that_the_volume_lacks_is_named(tmp_path, more, found):
    for name in ("kidney", "bone"):
        exercise = f"name: Find it\ntask: {{kind: centre, structure: {name}}}\n"
        (tmp_path / f"{name}.yaml").write_text(exercise, encoding="utf-8")
    grey = np.ones((4, 4, 4), np.uint8)
    write_volume(tmp_path / "grey.mha", Volume(grey, np.diag([1e-2, 1e-2, 1e-2, 1.0])))
    file = tmp_path / "scene.yaml"
    file.write_text(f"based_on: upper_arm\n{more.format(tmp_path)}\n", encoding="utf-8")
    scene = load_scene(file)
    for refuse in (check_files, prepare_scene):
        with pytest.raises(UsSimError, match=f"{file}: .*{found}") as refused:
            refuse(scene)
        assert "\n" not in str(refused.value)


def test_a_label_without_a_material_is_named_before_the_volume_is_made(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text("based_on: upper_arm\ntissue: {materials: {fat: null}}\n", encoding="utf-8")
    with pytest.raises(UsSimError, match=r"tissue\.materials\.fat"):
        check_files(load_scene(file))
