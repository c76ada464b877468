"""The examples in the docstrings do what they say."""

import doctest
import importlib
import pkgutil

import pytest

import us_sim

MODULES = sorted(
    info.name
    for info in pkgutil.walk_packages(us_sim.__path__, "us_sim.")
    if not info.name.startswith("us_sim.nodes")
)


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    module = importlib.import_module(name)
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    assert doctest.testmod(module, optionflags=flags).failed == 0


@pytest.mark.parametrize(
    "name",
    [
        "us_sim.geometry.pose",
        "us_sim.geometry.collider_distance",
        "us_sim.tissue.solvers.fem_cg",
        "us_sim.tissue.solvers.msds",
        "us_sim.tissue.solvers.msds_implicit",
        "us_sim.tissue.mesh.embedding",
        "us_sim.tissue.mesh.file",
        "us_sim.volume.surfaces.label_surface",
        "us_sim.skin.membrane",
        "us_sim.slicing.formation.image_formation",
        "us_sim.slicing.cutting.row_subdivision",
        "us_sim.slicing.cutting.scan_conversion",
        "us_sim.volume.phantom.phantom",
        "us_sim.volume.files.readers",
        "us_sim.recording.writer",
        "us_sim.recording.path",
        "us_sim.scene.reading",
        "us_sim.tracking.probe_tracking",
        "us_sim.scene.building",
    ],
)
def test_main_parts_show_how_they_are_used_without_ros(name):
    examples = doctest.DocTestFinder(recurse=False).find(importlib.import_module(name))
    assert examples
    assert len(examples[0].examples) >= 3
