"""A hand that moves the probe over the skin without any device: what mouse, keys and touch ask."""
