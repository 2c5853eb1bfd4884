"""Raw meshes: loaded, validated, cut to a disc, measured. numpy in, numpy out."""

from nsm.surfaces.catalogue import catalogue_names

__all__ = ["catalogue_names"]
