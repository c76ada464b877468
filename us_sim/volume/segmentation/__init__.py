"""Segmentation of volumes into labelled structures."""
