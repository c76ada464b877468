"""Latency of the running graph: how old the pose is when its image has come, hop by hop."""
