"""Poses, rigid motions, the shape of the probe, faces and normals of meshes."""
