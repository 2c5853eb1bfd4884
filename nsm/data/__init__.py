"""Lightning data modules over prepared surfaces; sampling stays on the device."""

from nsm.data.overfit import OverfitData
from nsm.data.sampling import Samples, SurfaceSampler

__all__ = ["OverfitData", "Samples", "SurfaceSampler"]
