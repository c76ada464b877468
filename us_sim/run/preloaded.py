"""Import what node processes share, in the process that forks them; never rclpy."""

from __future__ import annotations

import contextlib
import gc
import importlib
import signal

from us_sim.run.processes import end_with_parent

_SHARED = ("scipy.sparse", "us_sim.nodes.messages", "us_sim.nodes.settings")
"""No part of a scene: one that a scene does not name is not imported."""


def import_shared() -> None:
    """Import the modules that node processes share, and end with the parent process."""
    end_with_parent(signal.SIGKILL)
    with contextlib.suppress(ImportError):  # it works without a name in `ps`
        from setproctitle import setproctitle

        setproctitle("us_sim nodes")
    for name in _SHARED:
        importlib.import_module(name)
    import numpy as np

    from us_sim.geometry.triangles import compute_vertex_normals

    # With the first kernel that is loaded numba reads its tables of functions, for 0.7 s.
    compute_vertex_normals(np.eye(3), np.array([[0, 1, 2]]))
    gc.freeze()


import_shared()
