"""The simulator in a browser: one page, its server, and what streams to it."""

import us_sim.nodes  # noqa: F401 - provides rclpy where ROS 2 is not installed
