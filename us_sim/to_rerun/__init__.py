"""A session as rerun shows it: surfaces that deform, images where they were cut, forces, rates."""
