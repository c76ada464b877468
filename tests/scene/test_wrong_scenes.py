"""Mistakes in a scene's file: one sentence with file, key and what is right."""

import copy
import functools
import pathlib
import shutil

import pytest
import yaml

from us_sim.errors import SceneError
from us_sim.scene.reading import load_scene
from us_sim.share import shared_path

RIGHT = yaml.safe_load(
    """
name: right
volume: {phantom: upper_arm}
probe:
  aperture: 40 mm
  depth: 40 mm
  image: [64, 48]
  collider: {shape: sphere, radius: 2 cm}
tissue:
  mesh: {lower: [-20 mm, -20 mm, 0], upper: [20 mm, 20 mm, 40 mm], nodes: [3, 4, 5]}
  materials: {muscle: {young_modulus: 12 kPa}}
structures:
  vein: {}
  artery: {flow: {kind: venous, direction: [0, 1, 0], peak_velocity: 0.3, mean_velocity: 0.1}}
skin: {}
imaging: {acoustics: {tissues: {muscle: {fibres: [0, 1, 0]}}}}
"""
)


def scene_text(**sections: str) -> str:
    """The YAML of a right scene, with these sections instead of its own."""
    document = {key: value for key, value in RIGHT.items() if key not in sections}
    return yaml.safe_dump(document) + "".join(f"{k}: {v}\n" for k, v in sections.items())


def refusal_of(file: pathlib.Path, where: str, volume: pathlib.Path | None = None) -> str:
    """The one sentence of the error about a scene file; it begins with the file and a place."""
    with pytest.raises(SceneError) as caught:
        load_scene(file, volume=volume)
    said = str(caught.value)
    assert said.startswith(": ".join([str(file), *([where] if where else []), ""]))
    assert "\n" not in said
    return said


SOLVED = (
    "{mesh: {lower: [0, 0, 0], upper: [1, 1, 1]}, materials: {a: {young_modulus: 1}}, settings: %s}"
)


@pytest.mark.parametrize(
    ("section", "text", "key", "fact"),
    [
        (
            "tissue",
            SOLVED % "{fem_cg: {iteratons: 3}}",
            "tissue.settings.fem_cg.iteratons",
            "ions`",
        ),
        ("tissue", SOLVED % "{fem_nonlinaer: {}}", "tissue.settings.fem_nonlinaer", "linear`"),
        ("tracker", "{source: camera, camera: {}, haptic: {}}", "tracker.haptic", "camera"),
        ("tracker", "{entry: 0}", "tracker.entry", "pose_array"),
        ("structures", "{vein: {color: [1, 0, 0]}}", "structures.vein.color", "`colour`"),
        ("structures", "[vein, 3]", "structures", "3"),
        ('"qq\\nqq"', "3", "'qq\\nqq'", ""),
        ("1", "3", "1", ""),
        ("probe", "[" + "12345, " * 99 + "]", "probe", "12345"),
    ],
)
def test_a_mistake_in_a_file_is_one_short_sentence(tmp_path, section, text, key, fact):
    file = tmp_path / "mine.yaml"
    file.write_text(scene_text(**{section: text}))
    said = refusal_of(file, key)
    assert fact in said
    assert len(said) < len(str(file)) + 250


def keys_of(document, path=()):
    """Each key of a scene, with those that lead to it; names of things and axes are none."""
    for key, value in document.items():
        if not {"materials", "planes", "structures", "tissues"} & set(path[-1:]):
            yield *path, key
        if isinstance(value, dict):
            yield from keys_of(value, (*path, key))


@pytest.mark.parametrize("name", [f.name for f in shared_path("config/scenes").glob("*.yaml")])
def test_a_misspelt_key_is_refused_at_every_place(tmp_path, name):
    shutil.copytree(shared_path("config"), tmp_path / "config")
    file = tmp_path / "config" / "scenes" / name
    right = yaml.safe_load(file.read_text())
    for *path, key in keys_of(right):
        wrong = copy.deepcopy(right)
        section = functools.reduce(dict.__getitem__, path, wrong)
        section[f"{key}q"] = section.pop(key)
        file.write_text(yaml.safe_dump(wrong))
        refusal_of(file, ".".join([*path, f"{key}q"]), volume=file)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("name: !!python/object/apply:os.getcwd []", "line 1: "),
        ("{[1]: 2}", "line 1: "),
    ],
)
def test_a_file_that_is_no_yaml_is_one_sentence_with_its_line(tmp_path, text, where):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    refusal_of(file, where.removesuffix(": "))
