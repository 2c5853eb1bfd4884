"""Neural surface maps: surfaces as networks, and maps between them.

Examples:
    >>> import nsm
    >>> surface = nsm.Surface.load("terrain")
    >>> phi = nsm.overfit(surface)
    >>> phi(uv)
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from nsm.loading_libraries import loading_libraries

if TYPE_CHECKING:
    from nsm.api import map_collection, map_pair, overfit, parameterize
    from nsm.domains import Surface
    from nsm.errors import NsmError
    from nsm.extensions import (
        register_activation,
        register_analytic,
        register_block,
        register_encoding,
        register_energy,
    )
    from nsm.result_folders import load
    from nsm.results import NeuralSurface, Parameterization, SurfaceCollection, SurfaceMap
    from nsm.surfaces import catalogue_names

__all__ = [
    "NeuralSurface",
    "NsmError",
    "Parameterization",
    "Surface",
    "SurfaceCollection",
    "SurfaceMap",
    "catalogue_names",
    "load",
    "map_collection",
    "map_pair",
    "overfit",
    "parameterize",
    "register_activation",
    "register_analytic",
    "register_block",
    "register_encoding",
    "register_energy",
]

_HOME = {
    "NeuralSurface": "nsm.results",
    "NsmError": "nsm.errors",
    "Surface": "nsm.domains",
    "SurfaceCollection": "nsm.results",
    "SurfaceMap": "nsm.results",
    "map_collection": "nsm.api",
    "map_pair": "nsm.api",
    "catalogue_names": "nsm.surfaces",
    "load": "nsm.result_folders",
    "Parameterization": "nsm.results",
    "overfit": "nsm.api",
    "parameterize": "nsm.api",
    "register_activation": "nsm.extensions",
    "register_analytic": "nsm.extensions",
    "register_block": "nsm.extensions",
    "register_encoding": "nsm.extensions",
    "register_energy": "nsm.extensions",
}
__version__ = version("nsm")

# what extensions are written with: ``nsm.energies``, ``nsm.data``, ...
_PACKAGES = ("data", "domains", "energies", "maps", "results", "surfaces", "tasks")


def __getattr__(name: str) -> Any:
    # torch and Lightning take seconds to import: what needs neither should not wait for them
    if name not in _HOME and name not in _PACKAGES:
        raise AttributeError(f"module 'nsm' has no attribute {name!r}")
    with loading_libraries():
        if name in _PACKAGES:
            return import_module(f"nsm.{name}")
        return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, *_PACKAGES, "__version__"])
