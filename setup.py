"""What differs between pip (one command, `us-sim`) and colcon (one executable a node)."""

import os
import sys
from pathlib import Path

from setuptools import setup

NODES = [
    "nodes.camera_driver",
    "nodes.haptic_renderer",
    "nodes.image_writer",
    "nodes.openigtlink_bridge",
    "nodes.path_player",
    "nodes.probe_robot",
    "nodes.probe_tracker",
    "nodes.scorer",
    "nodes.session_player",
    "nodes.session_recorder",
    "nodes.skin_deformer",
    "nodes.slice_interpolator",
    "nodes.space_mouse_driver",
    "nodes.tissue_deformer",
    "viewer.viewer",
]
FOLDER = Path(__file__).resolve().parent
BY_COLCON = bool({"install", "develop"} & set(sys.argv))
"""colcon calls `setup.py install` or `setup.py develop`; pip builds a wheel."""

HAS_ROS_WHEELS = "platform_system == 'Linux' and platform_machine == 'x86_64'"
ROS = [
    f"ros-jazzy-rclpy[fastrtps]>=7.1.6,<7.2; {HAS_ROS_WHEELS}",
    f"ros-jazzy-common-interfaces>=5.3.6,<5.4; {HAS_ROS_WHEELS}",
]
"""The real rclpy, messages and Fast DDS."""
if BY_COLCON:
    ROS = []
elif os.environ.get("AMENT_PREFIX_PATH"):  # a sourced ROS 2, whose messages need Ubuntu's NumPy
    ROS = ["numpy<2; python_version < '3.13'"]


def console_scripts() -> list[str]:
    """`us-sim` alone in a wheel, all of whose scripts land on PATH; every node for `ros2 run`."""
    nodes = [f"{module.rpartition('.')[2]} = us_sim.{module}:main" for module in NODES]
    return ["us-sim = us_sim.command.main:main", *(nodes if BY_COLCON else [])]


def shared_files(folder: str) -> list[tuple[str, list[str]]]:
    """Every file below `folder`, to be installed under share/us_sim with its own subfolders."""
    files: dict[str, list[str]] = {}
    for path in sorted((FOLDER / folder).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            relative = path.relative_to(FOLDER)
            files.setdefault(f"share/us_sim/{relative.parent}", []).append(str(relative))
    return list(files.items())


setup(
    license="Apache-2.0",  # in pyproject.toml no form suits both setuptools 68 and 77
    python_requires=">=3.11",  # read from there, colcon would fail on it
    install_requires=[  # .ci/ubuntu tests the versions of Ubuntu 24.04, which are the oldest here
        *ROS,
        "matplotlib>=3.6.3",
        "filelock>=3.12",
        "lz4>=4",
        "mcap>=1.5",
        "nibabel>=5.3",
        "numba>=0.59",
        "numpy>=1.26.4",
        "opencv-python-headless>=4.8",
        "pandas>=2.1.4",
        "platformdirs>=4",
        "pynrrd>=1.1",
        "PyYAML>=6.0.1",
        "rosbags>=0.11",
        "scikit-image>=0.22",
        "scipy>=1.11.4",
        "setproctitle>=1.3.3",
        "SimpleITK>=2.3",
        "threadpoolctl>=3",
        "tqdm>=4.66",
        "zstandard>=0.22",
    ],
    data_files=[  # which `colcon build --symlink-install` links beside setup.py: all that it reads
        ("share/ament_index/resource_index/packages", ["resource/us_sim"]),
        ("share/us_sim", ["package.xml", "pyproject.toml", "README.md"]),
        *shared_files("launch"),
        *shared_files("config"),
        *shared_files("bags"),
    ],
    entry_points={"console_scripts": console_scripts()},
)
