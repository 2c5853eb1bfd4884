"""Meshes with a name: downloaded, part of an installed package, or computed."""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from nsm.errors import NsmError
from nsm.surfaces import bundled, shapes
from nsm.surfaces.cache import cache_folder, downloads
from nsm.surfaces.landmark_files import Marks, read_marks
from nsm.surfaces.loading import error_in, load_mesh

TIMEOUT_SECONDS = 30
_INSTEAD = "use surface=terrain or surface.path=FILE, or set NSM_MESH_URL to a mirror"
_CLASSIC = "https://raw.githubusercontent.com/alecjacobson/common-3d-test-models/master/data"
_ANIMALS = (
    "https://raw.githubusercontent.com/patr-schm/surface-maps-via-adaptive-triangulations/"
    "a1bf1ebae522a8f2ec5c0603420b7cd99db354fe/data/meshes"
)


@dataclass(frozen=True)
class _Remote:
    """A file at a public address; ``file`` is its name in the cache and on a mirror."""

    file: str
    url: str
    sha256: str
    description: str = ""


_REMOTE = {
    "bunny": _Remote(
        "stanford-bunny.obj",
        f"{_CLASSIC}/stanford-bunny.obj",
        "1eb35d1e21ce99e5ce911353b6be278990713448dd9e8f5c9387f9de39b32205",
        "Stanford bunny, 35947 vertices, five holes below (fetched)",
    ),
    "cow": _Remote(
        "cow.obj",
        f"{_CLASSIC}/cow.obj",
        "69afce548640bc2beb0c44894d1a24d5766cc9cd3fd74f3ec55b4e229104b23f",
        "Cow, 2903 vertices, closed (fetched)",
    ),
    "homer": _Remote(
        "homer.obj",
        f"{_CLASSIC}/homer.obj",
        "b20b1391fd62964f65703d748514d86d747d1202d38e55e0f1addac7a5a10e8b",
        "Homer Simpson, 6002 vertices, closed (fetched)",
    ),
    "igea": _Remote(
        "igea.ply",
        f"{_CLASSIC}/igea.ply",
        "75f065f8fefbb468363718a5df39cc73c89e97c2ce3fa8a3b0086a08bb466222",
        "Igea, a scanned head, 134345 vertices, closed (fetched)",
    ),
    "suzanne": _Remote(
        "suzanne.obj",
        f"{_CLASSIC}/suzanne.obj",
        "d8684326f9bd8cfc24d3d302c1042fa16f63d2e66e49ed56b413fa20bed271e6",
        "Blender's monkey head, 507 vertices, open at the eyes (fetched)",
    ),
    "cat": _Remote(
        "cat_horse-0.obj",
        f"{_ANIMALS}/yang2020/cat_horse/input0.obj",
        "40f92e9043c55b63577cbeee14821ec042446b01c330eeea7bde591bc201ba59",
        "Cat, 8377 vertices, closed, 17 landmarks in common with the horse (fetched)",
    ),
    "horse": _Remote(
        "cat_horse-1.obj",
        f"{_ANIMALS}/yang2020/cat_horse/input1.obj",
        "1eb915c3b9c997f4a6f11cc1e8435f72f878d317f765ba4e0b03dc019957f988",
        "Horse, 9493 vertices, closed, 17 landmarks in common with the cat (fetched)",
    ),
    "shrec07-381": _Remote(
        "shrec07-381.off",
        f"{_ANIMALS}/shrec/381.off",
        "8730bb6df17500293bf9c860ff417b942470124017dda79e01ddb070cdee6451",
        "SHREC 2007 four-legged animal 381, 6938 vertices, closed (fetched)",
    ),
    "shrec07-384": _Remote(
        "shrec07-384.off",
        f"{_ANIMALS}/shrec/384.off",
        "920118c3276bb989c84a3d82179978cdc333fdc05d3d4bd1a931d5e02adbb761",
        "SHREC 2007 four-legged animal 384, 4712 vertices, closed (fetched)",
    ),
    "shrec07-388": _Remote(
        "shrec07-388.off",
        f"{_ANIMALS}/shrec/388.off",
        "682defed90d1c823cb9d0e5b19347a0e6d6315b44549579fa2ee2a2036fb7fcd",
        "SHREC 2007 four-legged animal 388, 8411 vertices, closed (fetched)",
    ),
    "shrec07-393": _Remote(
        "shrec07-393.off",
        f"{_ANIMALS}/shrec/393.off",
        "d29b9248ee7be464d20ebee0101369ddcea6006332fd5cb2f5ee3af5ee49f80c",
        "SHREC 2007 four-legged animal 393, 9757 vertices, closed (fetched)",
    ),
}

_LANDMARKS = {
    "cat": _Remote(
        "cat_horse-0.txt",
        f"{_ANIMALS}/yang2020/cat_horse/landmarks0.txt",
        "4144296821981c30f46a59d4500dd7f07c6dabd0524a693b2b2bf42361984378",
    ),
    "horse": _Remote(
        "cat_horse-1.txt",
        f"{_ANIMALS}/yang2020/cat_horse/landmarks1.txt",
        "ce5d35e9282ac904a39038da0f67417892b1300a961e9090d77e4e306cb30697",
    ),
    "shrec07-381": _Remote(
        "shrec07-381.vts",
        f"{_ANIMALS}/shrec/381.vts",
        "d7619da7cac288f51010d991a6af802ad678965a6806ecf90134bc3cd739c408",
    ),
    "shrec07-384": _Remote(
        "shrec07-384.vts",
        f"{_ANIMALS}/shrec/384.vts",
        "7802ce114854537161e19387a3cab04aed1020bb685f81858837c89910a71016",
    ),
    "shrec07-388": _Remote(
        "shrec07-388.vts",
        f"{_ANIMALS}/shrec/388.vts",
        "d914c8be386ea4d6ffee074b16a6e71678a4e6992684ce59e400583c6c746956",
    ),
    "shrec07-393": _Remote(
        "shrec07-393.vts",
        f"{_ANIMALS}/shrec/393.vts",
        "c289ae42b83898ef3ec9baf55eb78a745eec9d031ee47fa5d70dc04ebfb658ba",
    ),
}

_LOCAL: dict[str, tuple[Callable[[], shapes.Mesh], str]] = {
    "terrain": (bundled.terrain, "Jacksboro fault elevation model, 15525 vertices, in metres"),
    "brain": (bundled.brain, "fsaverage5 left pial surface, 10242 vertices (nsm[brain])"),
    "nut": (partial(bundled.pyvista_example, "nut"), "pyvista's hexagonal nut (nsm[pyvista])"),
    "plane": (shapes.plane, "square [-1,1]^2, flat, 2025 vertices"),
    "hemisphere": (shapes.hemisphere, "upper half of the unit sphere, 1801 vertices"),
    "sphere": (shapes.sphere, "unit sphere, subdivided icosahedron, 2562 vertices"),
    "torus": (shapes.torus, "torus of radii 1 and 0.4, 2048 vertices"),
    "cylinder": (shapes.cylinder, "tube of radius 1 and height 2, open ends, 1984 vertices"),
    "cone": (shapes.cone, "cone of radius 1 and height 1.5, open base, 1801 vertices"),
    "saddle": (shapes.saddle, "z = (x^2 - y^2) / 2 over [-1,1]^2, 2025 vertices"),
}


def catalogue_names() -> dict[str, str]:
    """All names, in alphabetical order, with a one-line description of each mesh."""
    lines = {name: remote.description for name, remote in _REMOTE.items()}
    lines.update({name: description for name, (_, description) in _LOCAL.items()})
    return dict(sorted(lines.items()))


def catalogue_mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64 of a mesh of the catalogue, unrepaired.

    A downloaded mesh is checked against its sha256 and kept in the cache folder. The environment
    variable NSM_MESH_URL may name a mirror: a folder that has the files under the same names.

    Raises:
        NsmError: ``unknown_surface``, ``missing_package``, ``cache_not_writable``,
            ``download_failed`` or ``wrong_checksum``. The key is the name of the mesh or package.
    """
    if name in _LOCAL:
        return _LOCAL[name][0]()
    if name in _REMOTE:
        vertices, faces, _ = load_mesh(_fetch(name, _REMOTE[name]))
        return vertices, faces
    near = difflib.get_close_matches(name, catalogue_names(), n=1, cutoff=0.0)
    raise NsmError(
        f"'{name}' is not in the catalogue; did you mean '{near[0]}'? "
        "For your own mesh use surface.path=FILE",
        kind="unknown_surface",
        key=name,
    )


def has_landmarks(name: str) -> bool:
    """Whether a mesh of the catalogue comes with landmarks."""
    return name in _LANDMARKS


def catalogue_landmarks(name: str) -> Marks:
    """The landmarks of a mesh of the catalogue, fetched as the mesh is.

    Raises:
        NsmError: as :func:`catalogue_mesh`.
    """
    return read_marks(_fetch(name, _LANDMARKS[name]))


def _fetch(name: str, remote: _Remote) -> Path:
    """A file of the catalogue, downloaded and checked if it is not in the cache."""
    pooch = downloads()
    mirror = os.environ.get("NSM_MESH_URL")
    url = f"{mirror.rstrip('/')}/{remote.file}" if mirror else remote.url
    try:
        file = pooch.retrieve(
            url,
            known_hash=f"sha256:{remote.sha256}",
            fname=remote.file,
            path=cache_folder() / "meshes",
            downloader=pooch.HTTPDownloader(timeout=TIMEOUT_SECONDS),
        )
    except PermissionError as error:
        reason = f"cannot write to {error.filename or cache_folder()}"
        raise error_in(name, "cache_not_writable", f"{reason}; set NSM_CACHE") from error
    except OSError as error:  # requests' errors are OSErrors: no network, no such file, timeout
        reason = f"cannot download {url} ({type(error).__name__}); {_INSTEAD}"
        raise error_in(name, "download_failed", reason) from error
    except ValueError as error:  # pooch raises it for a wrong checksum and for an unusable address
        kind, reason = (
            ("wrong_checksum", "has the wrong checksum")
            if "hash" in str(error)
            else ("download_failed", "is not a usable address")
        )
        raise error_in(name, kind, f"{url} {reason}; {_INSTEAD}") from error
    return Path(file)
