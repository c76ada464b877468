"""DICOM files: their header, their images as grey values, and where those lie in space."""
