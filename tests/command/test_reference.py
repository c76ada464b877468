"""The reference page is what the code says, and its links lead somewhere."""

import re
from pathlib import Path

import pytest

from us_sim.command.main import main
from us_sim.command.reference import make_reference_sections, write_reference_page
from us_sim.nodes.settings import NODES, parameters_of
from us_sim.scene.reading import load_scene
from us_sim.settings.registry import SOLVERS, TRACKERS
from us_sim.settings.setting import rules_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference.md"


def test_the_page_is_what_the_code_says():
    assert PAGE.read_text(encoding="utf-8") == write_reference_page(), (
        "docs/reference.md is not what the code says: write it anew with "
        "`python -m us_sim reference --out docs/reference.md`"
    )


def keys_in(section):
    return set(re.findall(r"^\| `([^`]+)` \|", section.text, re.MULTILINE))


def test_every_parameter_of_every_node_is_on_it():
    sections = {section.path: section for _, section in make_reference_sections()}
    scene = load_scene("upper_arm")
    for node in NODES:
        told = keys_in(sections[node]) | keys_in(sections["scene_nodes"])
        told |= {f"strain.{key}" for key in keys_in(sections["strain"])}
        told |= keys_in(sections["imaging"]) | keys_in(sections["probe.geometry.linear"])
        for name in SOLVERS:
            if section := sections.get(f"tissue.settings.{name}"):
                told |= {f"{name}.{key}" for key in keys_in(section)}
        for name in ("one_euro", "kalman"):
            told |= {f"{name}.{key}" for key in keys_in(sections[f"tracker.filter.{name}"])}
        told |= {f"membrane.{key}" for key in keys_in(sections["skin"])}
        material = keys_in(sections["tissue.materials.NAME"])
        told |= {f"materials.{label}.{key}" for label in scene.tissue.materials for key in material}
        for name in ("colour", "spectrum", "m_mode"):
            told |= {f"{name}.{key}" for key in keys_in(sections[name])}
        flow = keys_in(sections["structures.NAME.flow"])
        told |= {f"flow.{name}.{key}" for name in scene.flows for key in flow}
        told |= {f"acoustics.{key}" for key in keys_in(sections["imaging.acoustics"])}
        tissue = keys_in(sections["imaging.acoustics.tissues.NAME"])
        labels = scene.imaging.acoustics.tissues
        told |= {f"acoustics.tissues.{label}.{key}" for label in labels for key in tissue}
        for prefix, settings in parameters_of(node, scene):
            assert {prefix + name for name in rules_of(settings)} <= told


def test_every_source_of_poses_is_on_it_with_all_its_keys():
    sections = {section.path: section for _, section in make_reference_sections()}
    assert keys_in(sections["tracker.source"]) == {"source", *TRACKERS}
    for name in TRACKERS:
        keys = set(rules_of(TRACKERS.load_settings(name)))
        assert not keys or keys_in(sections[f"tracker.{name}"]) == keys


def test_a_part_is_printed_by_its_name(capsys):
    assert main(["reference", "tracker.filter"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("### tracker.filter\n")
    assert "`minimum_cutoff`" in text
    assert "### tracker.gate" not in text


@pytest.mark.parametrize(
    ("name", "meant"),
    [("tissue.mehs", "tissue.mesh"), ("tissue.setting", "tissue.settings")],
)
def test_a_part_that_is_not_there_is_said(name, meant, capsys):
    assert main(["reference", name]) == 1
    assert f"did you mean '{meant}'?" in capsys.readouterr().err


def test_the_page_is_written_to_a_file(tmp_path):
    assert main(["reference", "--out", str(tmp_path / "page.md")]) == 0
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == write_reference_page()
