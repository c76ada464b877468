"""Exercises as scenes: what is loaded, which seed is drawn, and what is listed."""

import pytest

from us_sim.errors import SceneError
from us_sim.scene.listing import list_scenes
from us_sim.scene.reading import load_scene
from us_sim.scoring.exercise import read_installed_exercises

EXAMINATION = "name: e\nscene: upper_arm_drawn\nfeedback: afterwards\nseeds: [3, 3]\n"


def test_an_exercise_is_a_scene_of_its_own_name():
    scene = load_scene("exercise:compression")
    assert (scene.name, scene.volume.phantom) == ("compression", "thrombosed_arm")
    assert scene.exercise == scene.origin.removeprefix("exercise:")
    assert load_scene(scene.origin) == scene  # as each node loads it


def test_a_seed_is_drawn_once_for_all_nodes(tmp_path):
    drawn = load_scene("exercise:examination")
    assert 1 <= drawn.volume.seed <= 1000
    assert load_scene(drawn.origin) == drawn
    assert drawn.is_drawn
    assert not load_scene(drawn.origin).is_drawn
    assert load_scene("exercise:examination#7").volume.seed == 7
    file = tmp_path / "e.yaml"
    file.write_text(EXAMINATION + "task: {kind: compression}\n")
    assert load_scene(f"exercise:{file}").volume.seed == 3


def test_a_checksum_is_of_all_that_is_set_but_the_seed_wherever_it_lies(tmp_path):
    known = load_scene("exercise:examination#7")
    assert known.compute_checksum() == load_scene("exercise:examination#8").compute_checksum()
    checksums = []
    for folder, vein in (("a", 5), ("b", 5), ("c", 6)):
        (tmp_path / folder).mkdir()
        file = tmp_path / folder / "soft.yaml"
        soft = f"tissue: {{materials: {{vein: {{young_modulus: {vein} kPa}}}}}}"
        file.write_text(f"name: soft\nbased_on: upper_arm\n{soft}\n")
        checksums.append(load_scene(file).compute_checksum())
    assert checksums[0] == checksums[1] != checksums[2]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: e\ntask: {kind: keep_force}", "scene: is missing"),
        ("name: e\nscene: nowhere\ntask: {kind: keep_force}", "nowhere"),
        (EXAMINATION + "task: {kind: keep_force}", "feedback"),
    ],
)
def test_what_cannot_be_loaded_is_refused(tmp_path, text, said):
    file = tmp_path / "e.yaml"
    file.write_text(text)
    with pytest.raises(SceneError, match=said):
        load_scene(f"exercise:{file}")
    with pytest.raises(SceneError, match="nothing_of_this_name"):
        load_scene("exercise:nothing_of_this_name")


@pytest.mark.parametrize("name", ["examination#x", "examination#-1", "compression#3"])
def test_a_seed_that_is_none_is_refused(name):
    with pytest.raises(SceneError, match="seed"):
        load_scene(f"exercise:{name}")


def test_the_lesson_is_listed_first_and_in_its_order():
    lesson = [each.lesson for each in read_installed_exercises() if each.lesson]
    assert lesson == [1, 2, 3, 4, 5]
    listed = [each for each in list_scenes() if each.kind == "exercise"]
    assert [each.name for each in listed[:5]] == [e.name for e in read_installed_exercises()[:5]]
    for each in read_installed_exercises():
        load_scene(f"exercise:{each.origin}")
