"""Import what node processes share, in the process that forks them; never rclpy."""

from __future__ import annotations

import gc
import os
import signal

from us_sim.nodes import prepare_process
from us_sim.run.processes import end_with_parent


def import_shared() -> None:
    """Import what all nodes share; no part of a scene, which need not name it."""
    import numpy as np
    import scipy.sparse  # noqa: F401

    from us_sim.geometry.triangles import compute_vertex_normals
    from us_sim.nodes import messages, settings  # noqa: F401

    # With the first kernel that is loaded numba reads its tables of functions, for 0.7 s.
    compute_vertex_normals(np.eye(3), np.array([[0, 1, 2]]))
    gc.freeze()


def keep_forking() -> None:
    """Go on in a forked process; this one forks another when that is killed."""
    end_with_parent(signal.SIGKILL)
    prepare_process("us_sim keeper")
    while child := os.fork():
        while os.WIFSTOPPED(status := os.waitpid(child, os.WUNTRACED)[1]):
            os.kill(child, signal.SIGCONT)  # else no node would start any more
        if os.WIFEXITED(status):
            os._exit(os.WEXITSTATUS(status))
    end_with_parent(signal.SIGKILL)
    prepare_process("us_sim nodes")


import_shared()
keep_forking()
