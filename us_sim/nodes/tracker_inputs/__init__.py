"""Sources of poses that a scene may name, for the probe tracker."""
