"""Elastic forces and energies of tetrahedra and springs."""
