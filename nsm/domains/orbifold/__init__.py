"""Closed surfaces laid out without a seam: the flat orbifold 2222 and the flat torus."""
