"""Where rclpy keeps its logger."""
