"""Raw meshes: loaded, validated, cut to a disc, measured. numpy in, numpy out."""

from nsm.surfaces.atlas import unwrapped
from nsm.surfaces.catalogue import catalogue_mesh, catalogue_names

__all__ = ["catalogue_mesh", "catalogue_names", "unwrapped"]
