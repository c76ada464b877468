"""A scene's flows: blood in its vessels, and a sentence for what cannot flow."""

import pytest
import yaml

from us_sim.errors import SceneError
from us_sim.scene.building import blood_of, volume_of
from us_sim.scene.reading import load_scene

FLOW = {"kind": "venous", "direction": [0, -1, 0], "peak_velocity": 0.2, "mean_velocity": 0.07}


@pytest.fixture
def scene_with(tmp_path, small_scene):
    """The small scene with keys of its own."""

    def scene(**keys):
        file = tmp_path / "flow.yaml"
        file.write_text(yaml.safe_dump({"based_on": str(small_scene), **keys}))
        return load_scene(file)

    return scene


def refusal(scene):
    with pytest.raises(SceneError) as caught:
        blood_of(scene, volume_of(scene))
    return str(caught.value)


def test_the_arm_has_blood_in_its_vein_and_its_artery():
    scene = load_scene("upper_arm")
    blood = blood_of(scene, volume_of(scene))
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
    assert blood_of(scene, volume_of(scene)).vessels[0].areas.mean() < 3e-5
    assert "with blood in deep" in scene.parts()[3].reason


def test_what_is_no_tube_is_refused_with_file_key_and_reason(scene_with):
    scene = scene_with(structures={"muscle": {"flow": FLOW}})
    text = refusal(scene)
    assert text.startswith(f"{scene.origin}: structures.muscle.flow: the structure ")
    assert text.endswith(": a flow needs a tube")


def test_a_flow_across_its_vessel_and_one_of_no_label_are_refused(scene_with):
    across = scene_with(structures={"vein": {"flow": FLOW | {"direction": [1, 0, 0]}}})
    assert "structures.vein.flow.direction: [1.0, 0.0, 0.0] is across the" in refusal(across)
    nowhere = scene_with(structures={"aorta": {"flow": FLOW}})
    assert "structures.aorta: the volume has no label `aorta`" in refusal(nowhere)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"structures": {"vein": {"flow": {**FLOW, "kind": "lymph"}}}}, "flow.kind: 'lymph' is no"),
        ({"structures": {"vein": {"flow": {"kind": "venous"}}}}, "flow.direction: is missing"),
        ({"colour": {"nyquist_velocity": 0}}, "colour.nyquist_velocity: 0 m/s is outside"),
    ],
)
def test_settings_that_cannot_be_are_refused_with_file_and_key(scene_with, keys, sentence):
    with pytest.raises(SceneError) as caught:
        scene_with(**keys)
    assert sentence in str(caught.value)
    assert "flow.yaml: " in str(caught.value)


def test_a_surface_from_a_file_has_no_room_for_blood(scene_with, tmp_path):
    (tmp_path / "vein.stl").write_text("")
    with pytest.raises(SceneError, match=r"structures.vein.flow: is for structures around a label"):
        scene_with(structures={"vein": {"file": "vein.stl", "flow": FLOW}})
