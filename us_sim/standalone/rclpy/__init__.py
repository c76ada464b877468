"""The subset of rclpy that this project's nodes use."""
