"""Maps turn points into points; each answers ``map(x)`` and ``map.value_and_jacobian(x)``."""

from nsm.maps.activations import ACTIVATIONS, Activation
from nsm.maps.analytic import ANALYTIC, AnalyticSurface, Formula, build_analytic
from nsm.maps.composition import Composition, PointMap, Rotated
from nsm.maps.encodings import ENCODINGS, Encoding, RandomFourierFeatures, SplineGrid
from nsm.maps.inverse import Between, inverted
from nsm.maps.networks import BLOCKS, NeuralMap, build_map
from nsm.maps.planar import DiscMap, Planar, PlanarMap, SquareMap, build_planar
from nsm.maps.together import together

__all__ = [
    "ACTIVATIONS",
    "ANALYTIC",
    "BLOCKS",
    "ENCODINGS",
    "Activation",
    "Between",
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
    "together",
]
