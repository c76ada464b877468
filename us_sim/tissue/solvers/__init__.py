"""Tissue solvers: one file each, behind one interface."""
