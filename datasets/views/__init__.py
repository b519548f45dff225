"""Geometry of single views: cameras, poses, and images brought from one camera to another."""
