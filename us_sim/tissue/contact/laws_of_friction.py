"""What may hold between probe and tissue along the surface, as solvers' settings name it.

>>> from us_sim.tissue.contact.laws_of_friction import COEFFICIENT, CONTACTS
>>> CONTACTS, COEFFICIENT.parse(0.07)
(('frictionless', 'coulomb', 'sticking'), 0.07)
"""

from __future__ import annotations

from us_sim.settings.quantity import Quantity

CONTACTS = ("frictionless", "coulomb", "sticking")

COEFFICIENT = Quantity("number", 1e-9, 10.0)
"""Coulomb's: the greatest force along the surface over the push."""
