"""Closed meshes laid out on R²/Γ coarse first: the coarse mesh is solved for, the rest put back in.

On the full mesh Tutte's embedding squeezes limbs to nothing, exponentially in their length, and
no descent comes back from there. On a few hundred triangles it does not; each round of
:mod:`nsm.domains.decimation` is then undone without a flip, and relaxed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.domains.coarse_to_fine import mean_values
from nsm.domains.decimation import Round, coarsen, undo
from nsm.domains.kernels import innermost
from nsm.domains.orbifold import group
from nsm.domains.orbifold.collapses import collapsed
from nsm.domains.orbifold.newton import Quotient
from nsm.domains.orbifold.sweeps import Stars, colour_classes, relax
from nsm.domains.orbifold.tutte import best_lattice, edge_weights, tutte
from nsm.errors import NsmError
from nsm.stages import at
from nsm.surfaces import topology

AREA = {True: 2.0, False: 4.0}  # of the domain, with and without cones; the lattice has 4
_LATTICE = 4.0
_STEPS = 2  # of Newton's method on what was put back
_NEARER = 0.7  # how far a vertex that does not fit goes towards its target, each time
_TRIES = 3
_SMALL = 1500  # faces of a mesh that may be relaxed after every round
_WORST = 1e3  # times the mean: a triangle of so much energy is moved on its own
_LEAST_ROOM = 1e-14  # between a vertex and the sides around it: less is lost in rounding
_SLOW = 4000  # faces whose layout is told of


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


@dataclass(frozen=True)
class Hierarchy:
    """A mesh drawn together in two stages.

    The first stage keeps the surface's shape: its faces (F, 3), those that are gone with two equal
    corners; its rounds; which faces (F',) are left, and the vertices (V',) that they name. The
    second, on these alone and in their numbers, leaves a handful of faces (F', 3), and its rounds.
    """

    faces: np.ndarray
    rounds: list[Round]
    alive: np.ndarray
    ids: np.ndarray
    few: np.ndarray
    last_rounds: list[Round]


def hierarchy(
    vertices: np.ndarray, faces: np.ndarray, held: np.ndarray, effort: Effort
) -> Hierarchy:
    """Draw a closed mesh (V, 3), (F, 3) together; the vertices of a mask (V,) stay."""
    if len(faces) > _SLOW:
        at("drawing the mesh together")
    current, rounds = coarsen(vertices, faces, held, effort.coarse)
    alive = _alive(current)
    ids, local = topology.renumbered(current[alive], len(vertices))
    few, last_rounds = collapsed(vertices[ids], local[current[alive]], held[ids], effort.coarsest)
    return Hierarchy(current, rounds, alive, ids, few, last_rounds)


def laid_out(
    vertices: np.ndarray,
    faces: np.ndarray,
    lift: np.ndarray,
    cones: np.ndarray | None,
    *,
    weights: str = "uniform",
    effort: Effort | None = None,
    levels: Hierarchy | None = None,
) -> Layout:
    """Lay a closed mesh (V, 3), (F, 3) out with little symmetric Dirichlet energy, no flips.

    Args:
        lift: (F, 3, 3); the result's may have other canonical coordinates.
        cones: (4,) vertices; None for a torus.
        weights: of the first embedding, see :func:`tutte.edge_weights`.
        levels: if the mesh has been drawn together before, with the cones held.

    Raises:
        NsmError: a vertex finds no place without a flip, for lack of digits (``not_injective``).
    """
    effort = effort or Effort()
    held = np.zeros(len(vertices), dtype=bool)
    held[faces[0, 0] if cones is None else cones] = True
    area = AREA[cones is not None]
    levels = levels or hierarchy(vertices, faces, held, effort)
    ids, alive, rounds = levels.ids, levels.alive, levels.rounds
    local = np.full(len(vertices), -1)
    local[ids] = np.arange(len(ids))
    lift = _regauged(faces, lift, rounds + [_renamed(r, ids, alive) for r in levels.last_rounds])

    small = Layout(lift[alive], np.zeros((len(ids), 2)), np.eye(2))
    of_cones = None if cones is None else local[cones]
    few = levels.few.copy()
    _first(vertices[ids], few, small, of_cones, weights, area)
    _undone(vertices[ids], few, levels.last_rounds, small, held[ids], area, effort)
    # canonical coordinates near the domain have the most digits
    gauge = group.identities(len(vertices))
    x, gauge[ids] = group.into_domain(small.uv @ np.linalg.inv(small.lattice).T, cones is not None)
    if cones is not None:
        x[of_cones], gauge[cones] = group.CONES, group.IDENTITY
    lift = group.compose(lift, group.inverse(gauge[_clusters(len(vertices), rounds)[faces]]))
    layout = Layout(lift, np.zeros((len(vertices), 2)), small.lattice)
    layout.uv[ids] = x @ small.lattice.T
    _undone(vertices, levels.faces.copy(), rounds, layout, held, area, effort)
    return layout


def _renamed(step: Round, ids: np.ndarray, alive: np.ndarray) -> Round:
    """A round of a mesh with only some vertices and faces, in the numbers of the whole."""
    corners = 3 * alive[step.corners // 3] + step.corners % 3
    return Round(ids[step.vertex], ids[step.target], step.before, corners, step.star)


def _undone(
    vertices: np.ndarray,
    current: np.ndarray,
    rounds: list[Round],
    layout: Layout,
    held: np.ndarray,
    area: float,
    effort: Effort,
) -> None:
    """Relax a coarse mesh, and put back the vertices of all rounds."""
    alive = _alive(current)
    relax_all(vertices, current, alive, layout, held, area, effort, effort.last)
    done = len(alive)
    for step in reversed(rounds):
        undo(current, step)
        alive = _alive(current)
        tight = _put_back(scaled(vertices, current[alive], area), current, layout, step)
        if len(current) > _SLOW:
            at("faces laid out", len(alive), len(current))
        last = step is rounds[0]
        if last or len(alive) >= effort.growth * done:
            done = len(alive)
            steps = effort.last if last else effort.level
            relax_all(vertices, current, alive, layout, held, area, effort, steps)
        elif tight and len(alive) <= _SMALL:
            # where there is hardly room, make some before it is used up
            relax_all(vertices, current, alive, layout, held, area, effort, 1)


def relax_all(
    vertices: np.ndarray,
    faces: np.ndarray,
    alive: np.ndarray,
    layout: Layout,
    held: np.ndarray,
    area: float,
    effort: Effort,
    steps: int,
) -> None:
    """Lower the energy of those of the faces that are alive, by global steps or by sweeps."""
    present, lift = faces[alive], layout.lift[alive]
    mesh = scaled(vertices, present, area)
    small = len(present) <= 2 * effort.largest
    classes: list[Stars] | None = None
    quotient = Quotient(mesh, present, lift, held) if small else None
    if quotient is None:
        classes = list(colour_classes(mesh, present, lift, held))
        shape = _Shape(mesh, present, lift)
        for _ in range(effort.sweeps):
            layout.shaped(shape.best(layout))
            for stars in classes:
                relax(layout.uv, layout.lattice, stars)
        return
    before, stuck = np.inf, True
    for _ in range(steps):
        if stuck:
            # the worst triangles hold global steps up: move their vertices on their own
            classes = classes or list(colour_classes(mesh, present, lift, held))
            for _ in range(effort.sweeps):
                for stars in classes:
                    relax(layout.uv, layout.lattice, stars)
                energy, worst = quotient.spread(layout.uv, layout.lattice)
                if worst < _WORST * energy:
                    break
        layout.shaped(quotient.best_shape(layout.uv, layout.lattice))
        layout.uv, energy, size = quotient.step(layout.uv, layout.lattice)
        stuck = size < 0.1
        if not stuck and before - energy < effort.stop * energy:
            break
        before = energy


class _Shape:
    """The best shape of the lattice for meshes too large to need second derivatives."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, lift: np.ndarray) -> None:
        self.quotient = object.__new__(Quotient)
        Quotient.prepare(self.quotient, vertices, faces, lift)

    def best(self, layout: Layout) -> np.ndarray:
        return self.quotient.best_shape(layout.uv, layout.lattice)


def _alive(faces: np.ndarray) -> np.ndarray:
    a, b, c = faces.T
    return np.flatnonzero((a != b) & (b != c) & (c != a))


def scaled(vertices: np.ndarray, faces: np.ndarray, area: float) -> np.ndarray:
    """The vertices (V, 3) in a unit in which the faces have the given area."""
    return vertices * np.sqrt(area / topology.face_areas(vertices, faces).sum())


def _first(
    vertices: np.ndarray,
    faces: np.ndarray,
    layout: Layout,
    cones: np.ndarray | None,
    weights: str,
    area: float,
) -> None:
    """Tutte's embedding of the coarsest mesh."""
    alive = _alive(faces)
    present = faces[alive]
    weight = edge_weights(vertices, present, weights)
    x, quadratic = tutte(present, layout.lift[alive], weight, cones)
    layout.lattice = best_lattice(quadratic, _LATTICE)
    layout.uv[: len(x)] = x @ layout.lattice.T


def _clusters(count: int, rounds: list[Round]) -> np.ndarray:
    """The vertex (V,) that each is drawn into in the end."""
    into = np.arange(count)
    for step in reversed(rounds):
        into[step.vertex] = into[step.target]
    return into


def _regauged(faces: np.ndarray, lift: np.ndarray, rounds: list[Round]) -> np.ndarray:
    """Lifts (F, 3, 3) with canonical coordinates such that a vertex and the one that it is drawn
    into have the same lift in the triangles they share: lifts then stay as corners change names."""
    gauge = group.identities(int(faces.max()) + 1)
    current, into = faces.copy(), np.arange(len(gauge))
    for step in rounds:
        face, k = step.corners // 3, step.corners % 3
        here = current[face] == step.target[step.star][:, None]
        shared = np.flatnonzero(here.any(axis=1))
        which = np.unique(step.star[shared], return_index=True)[1]
        row = shared[which]
        f, kv, kw = face[row], k[row], here[row].argmax(axis=1)

        def now(f: np.ndarray, k: np.ndarray) -> np.ndarray:
            return group.compose(lift[f, k], group.inverse(gauge[faces[f, k]]))

        change = group.compose(group.inverse(now(f, kw)), now(f, kv))
        number = np.full(len(gauge), -1)
        number[step.vertex] = np.arange(len(step.vertex))
        members = np.flatnonzero(number[into] >= 0)
        mine = number[into[members]]
        gauge[members] = group.compose(change[mine], gauge[members])
        into[members] = step.target[mine]
        current.ravel()[step.corners] = step.target[step.star]
    return group.compose(lift, group.inverse(gauge[faces]))


def _put_back(vertices: np.ndarray, faces: np.ndarray, layout: Layout, step: Round) -> bool:
    """Give a round's vertices places that flip no triangle; whether one was hard to find."""
    stars = Stars(vertices, faces, layout.lift, step.vertex, step.corners, step.star)
    uv, lattice = layout.uv, layout.lattice
    b, c = stars.rings(uv, lattice)
    target = uv[step.target]
    place = mean_values(vertices, stars, b, c)
    missing = _placed(uv, stars, b, c, target, place)
    for number in missing.tolist():
        mine = stars.star == number
        at = innermost(b[mine], c[mine], _LEAST_ROOM)
        if at is None:
            raise NsmError("a vertex finds no place without a flip", kind="not_injective")
        uv[step.vertex[number]] = at
    for _ in range(_STEPS):
        relax(uv, lattice, stars)
    return len(missing) > 0


def _placed(
    uv: np.ndarray,
    stars: Stars,
    b: np.ndarray,
    c: np.ndarray,
    target: np.ndarray,
    place: np.ndarray,
) -> np.ndarray:
    """Move each middle to its place (N, 2), or as near to it from its target as it flips nothing;
    numbers of those that found no place."""
    missing, share = np.arange(len(place)), 1.0
    for _ in range(_TRIES):
        trial = target + share * (place - target)
        with np.errstate(all="ignore"):
            fits = np.isfinite(stars.energy(b, c, trial))
        uv[stars.vertex[fits]] = trial[fits]
        corners, left = ~fits[stars.star], ~fits
        stars, b, c = stars.chosen(left), b[corners], c[corners]
        target, place, missing = target[left], place[left], missing[left]
        if len(missing) == 0:
            break
        share *= _NEARER
    return missing
