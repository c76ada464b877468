"""The rclpy nodes. Importing this package provides rclpy where ROS 2 is not installed."""

import os

# Before NumPy loads its BLAS: several node processes share few cores, and small dense solves are
# far slower on many threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from us_sim.nodes.early_interrupt import end_at_once_when_interrupted

end_at_once_when_interrupted()  # before the imports that take a second

from us_sim.standalone import install  # noqa: E402

install()
