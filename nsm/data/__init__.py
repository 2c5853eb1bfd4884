"""Lightning data modules over prepared surfaces; sampling stays on the device."""

from nsm.data.collection import CollectionData
from nsm.data.overfit import EnsembleData, OverfitData
from nsm.data.sampling import Samples, SurfaceSampler

__all__ = ["CollectionData", "OverfitData", "Samples", "EnsembleData", "SurfaceSampler"]
