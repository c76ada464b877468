"""The springs between a tissue's surface and a probe: where they are, and how firm.

>>> from us_sim.tissue.contact.surface_contact import surface_contact
>>> from us_sim.tissue.model import TissueModel
>>> model = TissueModel.block()
>>> points, contact = surface_contact(model)
>>> len(points.rest), len(contact.gap)
(236, 236)
"""

from __future__ import annotations

import numpy as np

from us_sim.geometry.triangles import part_size
from us_sim.tissue.contact.flared_probe import FlaredProbe
from us_sim.tissue.contact.penalty_contact import PenaltyContact
from us_sim.tissue.contact.penalty_friction import PenaltyFriction
from us_sim.tissue.contact.surface_points import SurfacePoints
from us_sim.tissue.elasticity.linear_tetrahedra import nodal_shear_stiffness
from us_sim.tissue.elasticity.neo_hookean_material import withstood_force
from us_sim.tissue.model import TissueModel

_FIRMNESS = 30.0
"""Stiffness of the springs of a node, over the shear stiffness of the tissue there. The softer, the
deeper the probe sinks in; the firmer, the worse conditioned the equations, and the more a surface
counts that is flat where it should be bent. From 25 to 40 nodes are nearest to a fine mesh's."""

_STIFFENING = 0.2
"""Depth at which a spring pushes twice as much as if it were linear, over the nodes' spacing."""

_GREATEST_PUSH = 25.0
"""Greatest force of a node's springs, over `withstood_force` there: less than what a crushed
tetrahedron resists, so that no probe turns one inside out."""


def surface_contact(
    model: TissueModel, friction: float = 0.0
) -> tuple[SurfacePoints, PenaltyContact]:
    """Points on the surface of a tissue, and the contact at these.

    Args:
        model: of the tissue and the probe.
        friction: Coulomb's coefficient, infinite for a probe to which tissue sticks.
    """
    # A lone node has no neighbour to be apart from.
    spacing = model.contact_spacing or float(np.ptp(model.mesh.nodes, axis=0).min())
    points = SurfacePoints(model, part_size(float(model.collider.offset_box[3]), spacing))
    firm = _FIRMNESS * points.spread(nodal_shear_stiffness(model.mesh, model.materials))
    strongest = _GREATEST_PUSH * points.spread(withstood_force(model.mesh, model.materials))
    law = (FlaredProbe(model.collider, spacing), firm, strongest, _STIFFENING * spacing)
    return points, PenaltyFriction(*law, friction) if friction else PenaltyContact(*law)
