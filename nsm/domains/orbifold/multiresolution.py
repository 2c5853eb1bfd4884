"""Closed meshes laid out on R²/Γ coarse first: the coarse mesh is solved for, the rest put back in.

On the full mesh Tutte's embedding squeezes limbs to nothing, exponentially in their length, and
no descent comes back from there. On a few hundred triangles it does not; each round of
:mod:`nsm.domains.decimation` is then undone without a flip, and relaxed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nsm.domains.coarse_to_fine import mean_value_weights
from nsm.domains.decimation import Round, coarsen, has_area, undo
from nsm.domains.kernels import innermost
from nsm.domains.orbifold import group
from nsm.domains.orbifold.collapses import collapsed
from nsm.domains.orbifold.gauges import regauged
from nsm.domains.orbifold.newton import Quotient
from nsm.domains.orbifold.stars import Stars, seen
from nsm.domains.orbifold.sweeps import put_back, relax
from nsm.domains.orbifold.triangles import Triangles
from nsm.domains.orbifold.tutte import best_lattice, edge_weights, tutte
from nsm.errors import NsmError
from nsm.stages import at
from nsm.surfaces import topology

AREA = {True: 2.0, False: 4.0}  # of the domain, with and without cones; the lattice has 4
_LATTICE = 4.0
_STEPS = 2  # of Newton's method on what was put back
_SMALL = 1500  # faces of a mesh that may be relaxed after every round
_WORST = 1e3  # times the mean: a triangle of so much energy is moved on its own
_LEAST_ROOM = 1e-14  # between a vertex and the sides around it: less is lost in rounding
_SLOW = 4000  # faces whose layout is told of
_KEPT = 5000  # faces of a mesh for whose levels there is memory


@dataclass(frozen=True)
class Effort:
    """How much is done: faces of the first coarse mesh, whose shape is that of the surface, and of
    the last; steps on each level, and at the end; up to how many vertices a level gets global
    steps; sweeps where it does not."""

    coarse: int = 500
    coarsest: int = 20
    level: int = 5
    last: int = 15
    largest: int = 40_000
    sweeps: int = 6
    growth: float = 2.0  # of the faces between two relaxations of all vertices
    stop: float = 1e-4  # relative decrease of the energy in a step


@dataclass
class Layout:
    """A closed mesh on R²/Γ: lift (F, 3, 3), uv (V, 2) in the plane, lattice (2, 2) in columns."""

    lift: np.ndarray
    uv: np.ndarray
    lattice: np.ndarray

    def shaped(self, matrix: np.ndarray) -> None:
        """Apply a linear map (2, 2) to the plane."""
        self.uv = self.uv @ matrix.T
        self.lattice = matrix @ self.lattice


class Level:
    """A mesh on the way from a coarse one to the whole, and how its last vertices are put back.

    Attributes:
        alive: (F',) those of the whole mesh' faces that it has.
        mesh: its triangles.
        stars: of the vertices (N,) that are put back; None on the coarsest.
        target: (N,) what they had been drawn into.
        weights: (M, 2) of the stars' rings, mean values; those of a star add up to one.
    """

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, step: Round | None, area: float
    ) -> None:
        self.alive = np.flatnonzero(has_area(faces))
        self._faces, self._vertices = faces[self.alive], vertices
        self._scale = area / topology.face_areas(vertices, self._faces).sum()
        self.stars: Stars | None = None
        if step is not None:
            stars = Stars.of(vertices, faces, self._scale, step.vertex, step.corners, step.star)
            middle = np.repeat(stars.vertex, np.diff(stars.start))
            weights = mean_value_weights(vertices, middle, stars.ring.T, stars.shape[:, 3])
            total = np.add.reduceat(weights.sum(axis=0), stars.start[:-1])
            weights /= np.repeat(total, np.diff(stars.start))
            self.stars, self.weights = stars, np.ascontiguousarray(weights.T)
            self.target = step.target

    @cached_property
    def mesh(self) -> Triangles:
        return Triangles(self._vertices, self._faces, self._scale)


class Levels:
    """The meshes from a coarse one to the whole, the coarsest first.

    Args:
        vertices: (V, 3).
        faces: (F, 3) of the coarsest, those that are gone with two equal corners.
        rounds: of collapses that led to it.
        area: of the domain.
    """

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, rounds: list[Round], area: float
    ) -> None:
        self.vertices, self.faces, self.rounds, self.area = vertices, faces, rounds, area

    def __iter__(self) -> Iterator[Level]:
        # those of a small mesh are kept: more sets of cones may be tried on it
        return iter(self._kept if len(self.faces) <= _KEPT else self._made())

    def _made(self) -> Iterator[Level]:
        current = self.faces.copy()
        yield Level(self.vertices, current, None, self.area)
        for step in reversed(self.rounds):
            undo(current, step)
            yield Level(self.vertices, current, step, self.area)

    @cached_property
    def _kept(self) -> list[Level]:
        return list(self._made())


@dataclass(frozen=True)
class Hierarchy:
    """A mesh drawn together in two stages.

    The first stage keeps the surface's shape, and leaves some of the faces, with vertices ids
    (V',). The second, on these alone and in their numbers, leaves a handful of faces.
    """

    first: Levels
    ids: np.ndarray
    second: Levels


def hierarchy(
    vertices: np.ndarray,
    faces: np.ndarray,
    held: np.ndarray,
    effort: Effort,
    area: float,
    begun: tuple[np.ndarray, list[Round]] | None = None,
) -> Hierarchy:
    """Draw a closed mesh together.

    Args:
        vertices, faces: (V, 3), (F, 3).
        held: (V,) mask of vertices that stay.
        area: of the domain.
        begun: the faces (F, 3) after first rounds, in which these vertices stayed, and the rounds.
    """
    if len(faces) > _SLOW:
        at("drawing the mesh together")
    start, first = begun or (faces, [])
    current, rounds = coarsen(vertices, start, held, effort.coarse)
    rounds = first + rounds
    alive = np.flatnonzero(has_area(current))
    ids, local = topology.renumbered(current[alive], len(vertices))
    few, last_rounds = collapsed(vertices[ids], local[current[alive]], held[ids], effort.coarsest)
    return Hierarchy(
        Levels(vertices, current, rounds, area), ids, Levels(vertices[ids], few, last_rounds, area)
    )


def laid_out(
    vertices: np.ndarray,
    faces: np.ndarray,
    lift: np.ndarray,
    cones: np.ndarray | None,
    *,
    weights: str = "uniform",
    effort: Effort | None = None,
    levels: Hierarchy | None = None,
    begun: tuple[np.ndarray, list[Round]] | None = None,
) -> Layout:
    """Lay a closed mesh (V, 3), (F, 3) out with little symmetric Dirichlet energy, no flips.

    Args:
        lift: (F, 3, 3); the result's may have other canonical coordinates.
        cones: (4,) vertices; None for a torus.
        weights: of the first embedding, see :func:`tutte.edge_weights`.
        levels: if the mesh has been drawn together before, with the cones held; and
        begun: if that has only begun, see :func:`hierarchy`.

    Raises:
        NsmError: a vertex finds no place without a flip, for lack of digits (``not_injective``).
    """
    effort = effort or Effort()
    vertices, faces, lift = (np.ascontiguousarray(a) for a in (vertices, faces, lift))
    held = np.zeros(len(vertices), dtype=bool)
    held[faces[0, 0] if cones is None else cones] = True
    area = AREA[cones is not None]
    levels = levels or hierarchy(vertices, faces, held, effort, area, begun)
    ids, rounds = levels.ids, levels.first.rounds
    alive = np.flatnonzero(has_area(levels.first.faces))
    local = np.full(len(vertices), -1)
    local[ids] = np.arange(len(ids))
    lift = regauged(faces, lift, rounds + [_renamed(r, ids, alive) for r in levels.second.rounds])

    small = Layout(lift[alive], np.zeros((len(ids), 2)), np.eye(2))
    of_cones = None if cones is None else local[cones]
    _first(levels.second, small, of_cones, weights)
    _undone(levels.second, small, held[ids], effort)
    # canonical coordinates near the domain have the most digits
    gauge = group.identities(len(vertices))
    x, gauge[ids] = group.into_domain(small.uv @ np.linalg.inv(small.lattice).T, cones is not None)
    if cones is not None:
        x[of_cones], gauge[cones] = group.CONES, group.IDENTITY
    lift = group.compose(lift, group.inverse(gauge[_clusters(len(vertices), rounds)[faces]]))
    layout = Layout(lift, np.zeros((len(vertices), 2)), small.lattice)
    layout.uv[ids] = x @ small.lattice.T
    _undone(levels.first, layout, held, effort)
    return layout


def _renamed(step: Round, ids: np.ndarray, alive: np.ndarray) -> Round:
    """A round of a mesh with only some vertices and faces, in the numbers of the whole."""
    corners = 3 * alive[step.corners // 3] + step.corners % 3
    return Round(ids[step.vertex], ids[step.target], step.before, corners, step.star)


def _undone(levels: Levels, layout: Layout, held: np.ndarray, effort: Effort) -> None:
    """Relax a coarse mesh, and put back the vertices of all rounds."""
    lifts = seen(layout.lift)
    whole, done = len(levels.faces), 0
    for k, level in enumerate(levels):
        count, tight = len(level.alive), False
        if level.stars is not None:
            tight = _put_back(level, lifts, layout, held)
            if whole > _SLOW:
                at("faces laid out", count, whole)
        last = k == len(levels.rounds)
        if last or count >= effort.growth * done:
            steps = effort.last if last or not done else effort.level
            relax_all(level, lifts, layout, held, effort, steps)
            done = count
        elif tight and count <= _SMALL:
            # where there is hardly room, make some before it is used up
            relax_all(level, lifts, layout, held, effort, 1)


def relax_all(
    level: Level,
    lifts: np.ndarray,
    layout: Layout,
    held: np.ndarray,
    effort: Effort,
    steps: int,
) -> None:
    """Lower the energy of a level's faces, by global steps or by sweeps."""
    mesh = level.mesh
    lifts = lifts.reshape(-1, 3, 2, 3)[level.alive].reshape(-1, 2, 3)
    quotient = Quotient(mesh, lifts, held)

    def swept() -> np.ndarray:
        """The Jacobians after all vertices have moved on their own."""
        relax(layout.uv, layout.lattice, mesh.stars, lifts, held)
        return quotient.jacobians(layout.uv, layout.lattice)

    if len(level.alive) > 2 * effort.largest:
        j = quotient.jacobians(layout.uv, layout.lattice)
        for _ in range(effort.sweeps):
            layout.shaped(quotient.best_shape(j))
            j = swept()
        return
    before, stuck = np.inf, True
    for _ in range(steps):
        if stuck:
            # the worst triangles hold global steps up: move their vertices on their own
            for _ in range(effort.sweeps):
                j = swept()
                energy, worst = quotient.spread(j)
                if worst < _WORST * energy:
                    break
        shape = quotient.best_shape(j)
        layout.shaped(shape)
        j = shape @ j
        layout.uv, j, energy, size = quotient.step(layout.uv, layout.lattice, j)
        stuck = size < 0.1
        if not stuck and before - energy < effort.stop * energy:
            break
        before = energy


def _first(levels: Levels, layout: Layout, cones: np.ndarray | None, weights: str) -> None:
    """Tutte's embedding of the coarsest mesh."""
    alive = np.flatnonzero(has_area(levels.faces))
    present = levels.faces[alive]
    weight = edge_weights(levels.vertices, present, weights)
    x, quadratic = tutte(present, layout.lift[alive], weight, cones)
    layout.lattice = best_lattice(quadratic, _LATTICE)
    layout.uv[: len(x)] = x @ layout.lattice.T


def _clusters(count: int, rounds: list[Round]) -> np.ndarray:
    """The vertex (V,) that each is drawn into in the end."""
    into = np.arange(count)
    for step in reversed(rounds):
        into[step.vertex] = into[step.target]
    return into


def _put_back(level: Level, lifts: np.ndarray, layout: Layout, held: np.ndarray) -> bool:
    """Give a level's last vertices places that flip no triangle; whether one was hard to find."""
    stars, uv, lattice = level.stars, layout.uv, layout.lattice
    assert stars is not None
    missing = put_back(uv, lattice, stars, lifts, level.weights, level.target)
    for number in missing.tolist():
        b, c = stars.ring_places(number, uv, lattice, lifts)
        at = innermost(b, c, _LEAST_ROOM)
        if at is None:
            raise NsmError("a vertex finds no place without a flip", kind="not_injective")
        uv[stars.vertex[number]] = at
    for _ in range(_STEPS):
        relax(uv, lattice, stars, lifts, held)
    return len(missing) > 0
