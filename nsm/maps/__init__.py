"""Maps turn points into points; each answers ``map(x)`` and ``map.value_and_jacobian(x)``."""

from nsm.maps.activations import ACTIVATIONS, Activation
from nsm.maps.analytic import ANALYTIC, AnalyticSurface, build_analytic
from nsm.maps.composition import Composition, PointMap, Rotated
from nsm.maps.encodings import ENCODINGS, RandomFourierFeatures, SplineGrid
from nsm.maps.networks import BLOCKS, NeuralMap, build_map

__all__ = [
    "ACTIVATIONS",
    "ANALYTIC",
    "BLOCKS",
    "ENCODINGS",
    "Activation",
    "AnalyticSurface",
    "Composition",
    "NeuralMap",
    "PointMap",
    "RandomFourierFeatures",
    "Rotated",
    "SplineGrid",
    "build_analytic",
    "build_map",
]
