"""Lightning data modules over prepared surfaces; samples are drawn on the training's device."""

from nsm.data.collection import CollectionData
from nsm.data.levels import CollectionLevelData, LevelData
from nsm.data.sampler import Draws, Sampler
from nsm.data.sampling import Samples, SurfaceSampler
from nsm.data.surface import EnsembleData, SurfaceData

__all__ = [
    "CollectionData",
    "CollectionLevelData",
    "Draws",
    "EnsembleData",
    "LevelData",
    "Sampler",
    "Samples",
    "SurfaceData",
    "SurfaceSampler",
]
