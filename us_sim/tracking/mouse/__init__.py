"""6-DOF mice."""
