"""Base class, scene and options of datasets in files, and their label maps."""
