"""Depth from a surface: a mesh, a cloud or a height raster, to which a ray is cast for each pixel of a frame."""
