"""The examples in the docstrings do what they say."""

import doctest
import importlib
import pkgutil

import pytest

import us_sim

SKIPPED = ("us_sim.standalone", "us_sim.nodes")
MODULES = sorted(
    info.name
    for info in pkgutil.walk_packages(us_sim.__path__, "us_sim.")
    if not info.name.startswith(SKIPPED)
)


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    module = importlib.import_module(name)
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    assert doctest.testmod(module, optionflags=flags).failed == 0


@pytest.mark.parametrize(
    "name",
    [
        "us_sim.pose",
        "us_sim.collider",
        "us_sim.tissue.fem_cg",
        "us_sim.tissue.msds",
        "us_sim.tissue.msds_implicit",
        "us_sim.tissue.embedding",
        "us_sim.tissue.mesh_file",
        "us_sim.volume.label_surface",
        "us_sim.structures",
        "us_sim.skin.membrane",
        "us_sim.slicing.image_formation",
        "us_sim.slicing.row_subdivision",
        "us_sim.slicing.scan_conversion",
        "us_sim.volume.phantom",
        "us_sim.volume.readers",
        "us_sim.recording.writer",
        "us_sim.recording.path",
        "us_sim.scene_file",
        "us_sim.tracking.probe_tracking",
        "us_sim.tracking.frame_tree",
        "us_sim.tracker_assembly",
    ],
)
def test_main_parts_show_how_they_are_used_without_ros(name):
    examples = doctest.DocTestFinder(recurse=False).find(importlib.import_module(name))
    assert examples
    assert len(examples[0].examples) >= 3
