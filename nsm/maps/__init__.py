"""Maps turn points into points; each answers ``map(x)`` and ``map.value_and_jacobian(x)``."""

from nsm.maps.activations import ACTIVATIONS, Activation
from nsm.maps.encodings import ENCODINGS, RandomFourierFeatures, SplineGrid
from nsm.maps.networks import BLOCKS, NeuralMap, build_map

__all__ = [
    "ACTIVATIONS",
    "BLOCKS",
    "ENCODINGS",
    "Activation",
    "NeuralMap",
    "RandomFourierFeatures",
    "SplineGrid",
    "build_map",
]
