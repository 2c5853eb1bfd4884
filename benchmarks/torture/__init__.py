"""Meshes and files that are hard to bear, and what is checked of what becomes of them."""
