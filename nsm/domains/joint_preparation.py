"""Joint preparation of several meshes, so that their domains correspond."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from nsm.domains.base import Domain, Keys
from nsm.domains.common_boundaries import best_common_boundaries, needs_common_boundaries
from nsm.domains.common_cut import best_common_cut, common_fractions
from nsm.domains.embedding import GIVEN
from nsm.domains.names import bounded
from nsm.domains.names import domain as domain_of
from nsm.domains.names import stored as stored_domain
from nsm.domains.orbifold.common_cones import choose_common_cones, distinct
from nsm.domains.surface import Surface
from nsm.errors import NsmError
from nsm.side_by_side import at_once, side_by_side
from nsm.stages import at, counted
from nsm.surfaces import cache as cache_
from nsm.surfaces import topology
from nsm.surfaces.cutting import Cut
from nsm.surfaces.landmarks import kept_landmarks
from nsm.surfaces.validation import NO_DECISION, CleanMesh, Repairs, clean
from nsm.wording import number_of


@dataclass(frozen=True)
class Mesh:
    """A mesh as read: name, vertices (V, 3), faces (F, 3), and the log of reading it.

    ``closed_area`` is that to which a part is closed for a map into a whole shape, as
    :class:`nsm.surfaces.validation.Repairs` has it.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    log: tuple[str, ...] = ()
    closed_area: float | None = None

    def cleaned(self, repairs: Repairs) -> CleanMesh:
        """The mesh as a clean manifold."""
        return clean(self.vertices, self.faces, self.name, self.decided(repairs))

    def decided(self, repairs: Repairs) -> Repairs:
        """The decisions on all meshes, and that to close this one."""
        return replace(repairs, closed_area=self.closed_area)


def prepare_jointly(
    meshes: Sequence[Mesh],
    landmarks: Sequence[np.ndarray],
    *,
    domain: str | Domain = "disc",
    parameterization: str = "slim",
    seam: str = "auto",
    seam_landmarks: int | None = None,
    cache: bool = True,
    cones: Sequence[int] | None = None,
    repairs: Repairs = NO_DECISION,
    processes: int | None = 1,
) -> list[Surface]:
    """Prepare meshes so that corresponding landmarks have corresponding places in Ω.

    For a domain with boundary, closed meshes with two landmarks or more are cut along corresponding
    seams, and the landmarks on the seam get the same places on ∂Ω in all of them. So
    are open ones with several boundaries; boundaries that correspond have the same places then. On
    the orbifold, meshes with four landmarks or more get the same four as their cones, those whose
    domains are least distorted in the mean. Other meshes are prepared one by one.

    Args:
        meshes: two or more.
        landmarks: (L,) vertices of each, in the same order; -1 for one that a mesh lacks.
        domain, parameterization, cache, repairs: as for :meth:`Surface.load`.
        seam: ``shortest`` paths, or ``hidden`` ones, which prefer regions seen from few sides; or
            ``auto``, which tries both and keeps the seam for which the domains agree best; or
            ``own``: each mesh is cut by itself, around its landmarks.
        seam_landmarks: how many landmarks, mutually far ones, the seam passes through; by default
            all of them, or, with ``auto``, the number for which the domains agree best.
        cones: numbers of the four landmarks for the cones of the orbifold, which all meshes have;
            chosen by default.
        processes: how many meshes are laid out at once, as for
            :func:`nsm.side_by_side.side_by_side`.

    Raises:
        NsmError: a mesh that cannot be prepared; ``wrong_topology`` if genus or number of boundary
            loops differ; ``no_common_seam``.
    """
    domain = domain_of(domain)
    if parameterization == GIVEN:
        raise NsmError(
            "surface.parameterization=given: the meshes of a map are laid out alike; take slim",
            kind="unknown_option",
            key="surface.parameterization",
        )
    cleaned = [m.cleaned(repairs) for m in meshes]
    found = [
        kept_landmarks(c, ids, m.name) for c, ids, m in zip(cleaned, landmarks, meshes, strict=True)
    ]
    everywhere: np.ndarray = np.all(np.stack(found) >= 0, axis=0)
    common_ids = [ids[everywhere] for ids in found]
    enough = everywhere.sum() >= 2 if domain.has_boundary else len(distinct(common_ids)) >= 4
    apart = (seam == "own" and domain.has_boundary) or len(meshes) == 1
    kinds = [topology.genus_and_boundary(c.faces) for c in cleaned]
    genus, loops = check_common_topology([m.name for m in meshes], kinds)
    several = (
        domain.has_boundary
        and loops > 0
        and genus == 0
        and needs_common_boundaries(cleaned, common_ids[0])
    )
    alike = enough and loops == 0 and (genus == 0 or domain.has_boundary)
    if apart or not (several or alike):
        # apart, seams cannot pass one landmark in corresponding places
        inside = landmarks if apart else [np.zeros(0, np.int64)] * len(meshes)
        alone = partial(
            _alone, domain=domain, method=parameterization, cache=cache, repairs=repairs
        )
        return _laid_out(alone, list(zip(meshes, inside, strict=True)), processes)
    together = _digest(cleaned, found)
    options = {
        "together": together,
        "domain": stored_domain(domain),
        "method": parameterization,
        "seam": [seam, seam_landmarks],
        "repairs": asdict(repairs),
        **({} if cones is None else {"cones": list(cones)}),
    }
    # keys of the files: meshes that are equal once cleaned may still differ in vertex numbers
    keys = [cache_.preparation_key(m.vertices, m.faces, options) for m in meshes]
    surfaces = _stored(meshes, domain, keys) if cache else None
    if surfaces is None:
        if domain.has_boundary:
            one, parts = _cut_alike(
                meshes,
                cleaned,
                found,
                everywhere,
                domain,
                parameterization,
                seam,
                seam_landmarks,
                number=int(together[:15], 16),
            )
        else:
            four = None if cones is None else (np.cumsum(everywhere) - 1)[list(cones)].tolist()
            one, parts = _with_common_cones(
                meshes, cleaned, common_ids, domain, parameterization, four
            )
        surfaces = _laid_out(one, parts, processes)
        if cache:
            for key, surface in zip(keys, surfaces, strict=True):
                cache_.write(key, surface.to_stored())
    return [
        replace(surface, raw=(m.vertices, m.faces))
        for m, surface in zip(meshes, surfaces, strict=True)
    ]


def _alone(
    mesh: Mesh, around: np.ndarray, *, domain: Domain, method: str, cache: bool, repairs: Repairs
) -> Surface:
    """The surface of a mesh that is prepared by itself, its seam led around vertices (L,)."""
    return Surface.from_arrays(
        mesh.vertices,
        mesh.faces,
        name=mesh.name,
        domain=domain,
        parameterization=method,
        cache=cache,
        log=mesh.log,
        repairs=mesh.decided(repairs),
        off_seam=around[around >= 0].tolist(),
    )


def _digest(cleaned: Sequence[CleanMesh], landmarks: Sequence[np.ndarray]) -> str:
    """A hash of meshes and of their landmarks."""
    digest = hashlib.sha256()
    for c, ids in zip(cleaned, landmarks, strict=True):
        for array in (c.vertices, c.faces, ids):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _stored(meshes: Sequence[Mesh], domain: Domain, keys: Sequence[str]) -> list[Surface] | None:
    """The surfaces stored under these keys; None if one is missing."""
    found = []
    for m, key in zip(meshes, keys, strict=True):
        stored = cache_.read(key)
        if stored is None:
            return None
        found.append(Surface.from_stored(m.name, domain, stored))
    return found


def _laid_out(
    one: Callable[..., Surface], parts: Sequence[tuple[Any, ...]], processes: int | None
) -> list[Surface]:
    """The surfaces of meshes, each laid out by a call with its part, several at once."""
    if at_once(len(parts), processes) < 2:
        return [one(*part) for part in counted("layout on the domain", parts)]
    at("layout on the domain")
    return side_by_side([partial(one, *part) for part in parts], processes)


def _with_common_cones(
    meshes: Sequence[Mesh],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    domain: Domain,
    method: str,
    four: Sequence[int] | None,
) -> tuple[Callable[..., Surface], list[tuple[Any, ...]]]:
    """What lays out a mesh, and its arguments for each."""
    arrays = [(c.vertices, c.faces) for c in cleaned]
    numbers, score = choose_common_cones(arrays, landmarks, four)
    line = (
        f"cones at landmarks {numbers.tolist()}, counted from 0, the same on all meshes: mean log "
        f"distortion {score:.3f}"
    )

    def one(m: Mesh, c: CleanMesh, ids: np.ndarray) -> Surface:
        return Surface.from_closed(
            c,
            name=m.name,
            domain=domain,
            parameterization=method,
            cones=ids[numbers].tolist(),
            log=(*m.log, *c.log, line),
        )

    return one, list(zip(meshes, cleaned, landmarks, strict=True))


def check_common_topology(
    names: Sequence[str], found: Sequence[tuple[int, int]]
) -> tuple[int, int]:
    """Genus and number of boundary loops of all surfaces.

    Raises:
        NsmError: ``wrong_topology``: they differ; a map would be torn.
    """
    for name, (genus, loops) in zip(names, found, strict=True):
        if (genus, loops) != found[0]:
            if genus == found[0][0] and 0 in (loops, found[0][1]):
                open_, closed = (name, names[0]) if loops else (names[0], name)
                raise NsmError(
                    f"{open_} has a boundary and {closed} has none: task=pair_map on "
                    "domain=orbifold takes an open source of genus 0 into a closed target; other "
                    f"maps need one topology: close the holes of {open_}, or cut from {closed} the "
                    "part that corresponds",
                    kind="wrong_topology",
                    key=name,
                )
            raise NsmError(
                f"{name} has genus {genus} and {number_of(loops, 'boundary loop')}, "
                f"{names[0]} genus {found[0][0]} and {found[0][1]}: a map between them would tear; "
                "fill holes, as surface.fill_holes=true does with small ones, or remove handles "
                "until they agree",
                kind="wrong_topology",
                key=name,
            )
    return found[0]


def _cut_alike(
    meshes: Sequence[Mesh],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    everywhere: np.ndarray,
    domain: Domain,
    method: str,
    seam: str,
    seam_landmarks: int | None,
    number: int,
) -> tuple[Callable[..., Surface], list[tuple[Any, ...]]]:
    """As :func:`_with_common_cones`, for a domain with boundary: the meshes are cut through
    landmarks that all have, mask (L,), and past all others."""
    names = [m.name for m in meshes]
    common = [ids[everywhere] for ids in landmarks]
    others = [ids[~everywhere & (ids >= 0)] for ids in landmarks]
    what = names, cleaned, common, seam, seam_landmarks, others
    ends: Sequence[np.ndarray | None] = [None] * len(meshes)
    said: list[tuple[str, ...]] = [()] * len(meshes)
    if topology.boundary_loops(cleaned[0].faces):
        best, found, lines = best_common_boundaries(*what)
        own = zip(cleaned, found, strict=True)
        ends = [np.array([number, *c.source_vertex[vertices]]) for c, vertices in own]
        said = [(line,) for line in lines]
    else:
        best = best_common_cut(*what)
    fractions = common_fractions(best.cuts, best.keys, bounded(domain))
    line = (
        f"seam led along {best.seam} paths through {best.count} of "
        f"{number_of(len(common[0]), 'landmark')}, "
        "the same on all meshes"
    )

    def one(
        m: Mesh,
        c: CleanMesh,
        cut: Cut,
        key: np.ndarray,
        end: np.ndarray | None,
        more: tuple[str, ...],
    ) -> Surface:
        surface = Surface.from_cut(
            cut,
            c,
            name=m.name,
            domain=domain,
            parameterization=method,
            keys=Keys(key, fractions),
            log=(*m.log, *c.log, *more, line),
        )
        return replace(surface, ends=end)

    return one, list(zip(meshes, cleaned, best.cuts, best.keys, ends, said, strict=True))
