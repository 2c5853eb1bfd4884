"""Maps turn points into points; each answers ``map(x)`` and ``map.value_and_jacobian(x)``."""

from nsm.maps.activations import Activation, as_activation
from nsm.maps.analytic import ANALYTIC, AnalyticSurface, Formula, build_analytic
from nsm.maps.analytic_closed import ClosedAnalyticSurface
from nsm.maps.batched_maps import batched
from nsm.maps.composition import Composition, LatticeAligned, Placed, PointMap, Rotated
from nsm.maps.encodings import Encoding, Identity, RandomFourierFeatures, SplineGrid
from nsm.maps.equivariant import EquivariantMap, TorusMap
from nsm.maps.inverse import TransitionMap, inverted
from nsm.maps.lattice_grid import LatticeSplineGrid
from nsm.maps.multilevel_spline import MultilevelSpline
from nsm.maps.networks import BLOCKS, NeuralMap, PlanarNetwork, build_network, build_stored
from nsm.maps.planar import DiscMap, IdentityInitializedMap, PlanarMap, SquareMap
from nsm.maps.spline_field import SplineField
from nsm.maps.started import LinearInFeatures, StartedMap
from nsm.maps.tabulated import Remembered, Tabulated

__all__ = [
    "ANALYTIC",
    "BLOCKS",
    "Activation",
    "AnalyticSurface",
    "ClosedAnalyticSurface",
    "Composition",
    "DiscMap",
    "Encoding",
    "EquivariantMap",
    "Formula",
    "Identity",
    "IdentityInitializedMap",
    "LatticeAligned",
    "LatticeSplineGrid",
    "LinearInFeatures",
    "MultilevelSpline",
    "NeuralMap",
    "Placed",
    "PlanarMap",
    "PlanarNetwork",
    "PointMap",
    "RandomFourierFeatures",
    "Remembered",
    "Rotated",
    "SplineField",
    "SplineGrid",
    "SquareMap",
    "StartedMap",
    "Tabulated",
    "TorusMap",
    "TransitionMap",
    "as_activation",
    "batched",
    "build_analytic",
    "build_network",
    "build_stored",
    "inverted",
]
