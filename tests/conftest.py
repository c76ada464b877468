"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

import us_sim.nodes  # noqa: F401 - provides rclpy where ROS 2 is not installed

_BESIDE_THE_PROJECT = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings: US_SIM_TEST_DATA, or shared/data beside the project."""
    folder = Path(os.environ.get("US_SIM_TEST_DATA", _BESIDE_THE_PROJECT))
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is not a folder; set US_SIM_TEST_DATA to one")
    return folder


SMALL_SCENE = """
name: small
volume: {phantom: upper_arm, seed: 1, voxel_size: 1 mm}
probe:
  aperture: 40 mm
  depth: 40 mm
  image: [96, 80]
  collider: {shape: rounded_box, length: 46 mm, width: 14 mm, height: 40 mm, rounding: 4 mm}
tissue:
  mesh: {lower: [-36 mm, -30 mm, 0], upper: [36 mm, 30 mm, 50 mm], nodes: [9, 6, 8]}
  fixed: [bottom, sides]
  materials:
    skin: {young_modulus: 30 kPa}
    fat: {young_modulus: 5 kPa}
    muscle: {young_modulus: 12 kPa}
    bone: {young_modulus: 1 MPa}
    artery: {young_modulus: 200 kPa}
    vein: {young_modulus: 0.4 kPa, poisson_ratio: 0.05}
    nerve: {young_modulus: 40 kPa}
skin: {size: [120 mm, 100 mm], spacing: 8 mm, flat_width: 72 mm, radius: 45 mm}
"""


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with everything in it, small enough for a test."""
    file = tmp_path_factory.mktemp("scene") / "small.yaml"
    file.write_text(SMALL_SCENE)
    return file


@pytest.fixture(scope="session", autouse=True)
def _own_corner() -> None:
    """Keep the tests' DDS on this host and out of other simulations' domain."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    own = str(1 + os.getpid() % 100)
    if "PYTEST_XDIST_WORKER" in os.environ:
        os.environ["ROS_DOMAIN_ID"] = own  # the workers must not hear each other
    os.environ.setdefault("ROS_DOMAIN_ID", own)
