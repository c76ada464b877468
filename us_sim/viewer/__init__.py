"""The simulator in a browser: one page, its server, and its streams."""

import us_sim.nodes  # noqa: F401 - provides rclpy where ROS 2 is not installed
