"""Meshes made ready: loaded, validated, cut to a disc and parameterised. numpy in, numpy out."""

from nsm.surfaces.catalogue import catalogue_names
from nsm.surfaces.surface import Surface

__all__ = ["Surface", "catalogue_names"]
