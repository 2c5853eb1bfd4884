"""Difficult meshes and files, and the checks of the results."""
