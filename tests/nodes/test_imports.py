"""What nodes import before they work: whatever is among it is waited for at every start."""

import subprocess
import sys

import pytest

UNUSED = [
    ("us_sim.viewer.viewer, us_sim.viewer.page", {"numba", "scipy"}),
    ("us_sim.nodes.probe_tracker", {"numba", "scipy", "cv2"}),
    ("us_sim.nodes.session_recorder", {"numba", "scipy", "cv2"}),
    ("us_sim.nodes.path_player", {"numba", "scipy", "cv2"}),
    ("us_sim.nodes.tissue_deformer", {"scipy.ndimage", "scipy.spatial", "cv2"}),
    (
        "us_sim.nodes.slice_interpolator, us_sim.slicing.acoustics.beam_acoustics, "
        "us_sim.nodes.streams.doppler, us_sim.slicing.flow.doppler",
        {"scipy.ndimage", "scipy.spatial"},
    ),
]


@pytest.mark.parametrize(("modules", "unused"), UNUSED)
def test_what_a_node_does_not_use_it_does_not_import(modules, unused):
    program = f"import sys, {modules}\nprint(*({unused!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, []), done.stderr
