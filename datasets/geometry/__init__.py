"""Geometry of single views: cameras, poses and lenses."""
