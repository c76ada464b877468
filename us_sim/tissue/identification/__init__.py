"""Stiffness of tissue from a recorded press: Young's moduli, and how well they are known."""
