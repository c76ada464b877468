"""Soft tissue: meshes, materials, contact with the probe, and the solvers that deform it."""
