"""Maps turn points into points; each answers ``map(x)`` and ``map.value_and_jacobian(x)``."""

from nsm.maps.activations import ACTIVATIONS, Activation
from nsm.maps.analytic import ANALYTIC, AnalyticSurface, Formula, build_analytic
from nsm.maps.batched_maps import batched
from nsm.maps.composition import Composition, PointMap, Rotated
from nsm.maps.encodings import ENCODINGS, Encoding, RandomFourierFeatures, SplineGrid
from nsm.maps.inverse import TransitionMap, inverted
from nsm.maps.networks import BLOCKS, NeuralMap, build_map
from nsm.maps.planar import DiscMap, Planar, PlanarMap, SquareMap, build_planar

__all__ = [
    "ACTIVATIONS",
    "ANALYTIC",
    "BLOCKS",
    "ENCODINGS",
    "Activation",
    "TransitionMap",
    "AnalyticSurface",
    "Composition",
    "DiscMap",
    "Encoding",
    "Formula",
    "NeuralMap",
    "Planar",
    "PlanarMap",
    "PointMap",
    "RandomFourierFeatures",
    "Rotated",
    "SplineGrid",
    "SquareMap",
    "build_analytic",
    "build_map",
    "build_planar",
    "inverted",
    "batched",
]
