"""A closed surface laid out on the flat orbifold 2222 or the flat torus, from its raw mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from nsm.domains.decimation import coarsen, present_faces
from nsm.domains.orbifold import group
from nsm.domains.orbifold.certificate import Certificate, certificate
from nsm.domains.orbifold.cones import LARGE, choose_cones
from nsm.domains.orbifold.lifts import check_sphere, cone_lifts, torus_lifts
from nsm.domains.orbifold.multiresolution import Effort, laid_out
from nsm.domains.orbifold.newton import distortions
from nsm.domains.orbifold.tutte import upright
from nsm.errors import NsmError
from nsm.wording import number_of

# Ω is R²/Γ with the lattice 2Z x 2Z: coordinates of Ω are twice those of the lattice.
SIDE = 2.0


@dataclass(frozen=True)
class Embedding:
    """A homeomorphism of a closed mesh onto Ω = R²/Γ, linear on each triangle in the cover.

    Attributes:
        faces: (F, 3), as given.
        uv: (V, 2) canonical coordinate of each vertex, in the fundamental domain [-1, 1] x [0, 1]
            of the orbifold or [-1, 1] x [-1, 1] of the torus.
        lift: (F, 3, 3) integers (s, m, n): corner k of face f lies at s uv + 2 (m, n).
        lattice: (2, 2) with determinant 4, columns upright: in the plane of coordinates
            (lattice / 2) uv the surface is least distorted; identity times two for a square.
        cones: (4,) vertices at (0, 0), (1, 0), (1, 1), (0, 1); None for the torus.
        log: what was chosen.
    """

    faces: np.ndarray
    uv: np.ndarray
    lift: np.ndarray
    lattice: np.ndarray
    cones: np.ndarray | None
    log: tuple[str, ...]

    def lifts(self, matrix: np.ndarray | None = None) -> np.ndarray:
        """The lifts (F, 3, 3), or those of images under a map h with h(x + 2k) = h(x) + 2 A k.

        Args:
            matrix: A (2, 2), integers with determinant 1: the isotopy class of h; the identity
                if not given.
        """
        if matrix is None:
            return self.lift
        shift = self.lift[:, :, 1:] @ np.asarray(matrix, dtype=np.int64).T
        return np.concatenate([self.lift[:, :, :1], shift], axis=2)

    def corners(self, uv: np.ndarray | None = None, matrix: np.ndarray | None = None) -> np.ndarray:
        """Places (F, 3, 2) of the triangles' corners, each triangle in one piece.

        Of images (V, 2) of the vertices under an equivariant map of class ``matrix``, if given.
        """
        points, lift = self.uv if uv is None else uv, self.lifts(matrix)
        return lift[:, :, :1] * points[self.faces] + SIDE * lift[:, :, 1:]

    @property
    def area(self) -> float:
        """Of Ω in the plane of the lattice."""
        return float(np.linalg.det(self.lattice)) / (1 if self.cones is None else 2)

    def copies(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The mesh with a copy of a vertex for each of its lifts that a triangle has a corner at.

        Returns:
            of each copy the vertex (C,) and its place (C, 2), one copy of every vertex first, in
            the vertices' order; and the faces (F, 3), whose triangles lie at :meth:`corners`.
        """
        element = self.lift.copy()
        if self.cones is not None:
            # at a cone, a lift and the one after its half-turn are one place
            x = np.zeros((len(self.uv), 2), dtype=np.int64)
            x[self.cones] = np.rint(self.uv[self.cones]).astype(np.int64)  # twice the lattice's
            turned = np.isin(self.faces, self.cones) & (element[..., 0] < 0)
            element[turned, 1:] -= x[self.faces[turned]]
            element[turned, 0] = 1
        reach = 2 * int(np.abs(element[..., 1:]).max()) + 2
        s, m, n = np.moveaxis(element, -1, 0)
        code = ((s < 0) * reach + np.abs(m) * 2 + (m < 0)) * reach + np.abs(n) * 2 + (n < 0)
        number = self.faces * (2 * reach * reach) + code  # the identity is the least of a vertex
        _, at, copy = np.unique(number, return_index=True, return_inverse=True)
        vertex = self.faces.ravel()[at]
        is_first = np.diff(vertex, prepend=-1) != 0
        order = np.argsort(~is_first, kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        uv = self.corners().reshape(-1, 2)[at[order]]
        return vertex[order], uv, place[copy.reshape(self.faces.shape)]

    def certificate(
        self, uv: np.ndarray | None = None, matrix: np.ndarray | None = None
    ) -> Certificate:
        """Exact check of the embedding, or of images (V, 2) of its vertices under an equivariant
        map of class ``matrix``."""
        points = self.uv if uv is None else uv
        return certificate(self.faces, self.lifts(matrix), points / SIDE, self.cones)

    def distortions(self, vertices: np.ndarray, epsilon: float = 0.01) -> np.ndarray:
        """Symmetric Dirichlet energy (F,) of the map from (V, 3) to the plane of the lattice."""
        return distortions(
            vertices, self.faces, self.lift, self.uv / SIDE, self.lattice, epsilon=epsilon
        )


def embed_orbifold(
    vertices: np.ndarray,
    faces: np.ndarray,
    cones: Sequence[int] | None = None,
    *,
    keep_order: bool | None = None,
    effort: Effort | None = None,
) -> Embedding:
    """Lay a closed surface of genus 0 out on the orbifold 2222.

    Args:
        vertices: (V, 3).
        faces: (F, 3), one closed oriented manifold component.
        cones: four vertices, in the order of (0, 0), (1, 0), (1, 1), (0, 1); chosen among the
            surface's extremities if not given.
        keep_order: whether the cones keep their order; if not, they take the one for which the
            lattice is least sheared. By default given cones keep it, and chosen ones do not.
        effort: how much is done.

    Raises:
        NsmError: the surface is of another topology (``wrong_topology``), the cones are not four
            of its vertices (``wrong_cones``), or digits do not suffice (``not_injective``).
    """
    log: list[str] = []
    keep_order = cones is not None if keep_order is None else keep_order
    begun = None
    if cones is None:
        check_sphere(faces)
        few = faces
        if len(faces) > LARGE:  # the cones are vertices that stay
            nothing = np.zeros(len(vertices), dtype=bool)
            begun = coarsen(vertices, faces, nothing, LARGE // 2)
            few = present_faces(begun[0])
        chosen, table = choose_cones(vertices, few)
        cones = chosen.tolist()
        log += [f"cones {list(four)}: mean log distortion {value:.3f}" for value, four in table]
    corners = np.asarray(cones, dtype=np.int64)
    lift, _ = cone_lifts(vertices, faces, corners.tolist())
    layout = laid_out(vertices, faces, lift, corners, effort=effort, begun=begun)
    x = np.linalg.solve(layout.lattice, layout.uv.T).T
    x[corners] = group.CONES
    return _finished(faces, layout.lift, x, layout.lattice, corners, keep_order, log)


def embed_torus(
    vertices: np.ndarray, faces: np.ndarray, *, effort: Effort | None = None
) -> Embedding:
    """Lay a closed surface of genus 1, (V, 3) and (F, 3), out on the torus.

    Raises:
        NsmError: the surface is of another topology (``wrong_topology``), or digits do not
            suffice (``not_injective``).
    """
    layout = laid_out(vertices, faces, torus_lifts(faces), None, effort=effort)
    x = np.linalg.solve(layout.lattice, layout.uv.T).T
    return _finished(faces, layout.lift, x, layout.lattice, None, False, [])


def _finished(
    faces: np.ndarray,
    lift: np.ndarray,
    x: np.ndarray,
    lattice: np.ndarray,
    cones: np.ndarray | None,
    keep_order: bool,
    log: list[str],
) -> Embedding:
    """In a reduced basis of the lattice."""
    basis = reduced_basis(lattice, even=cones is not None and keep_order)
    inverse = np.rint(np.linalg.inv(basis)).astype(np.int64)
    lattice, x = lattice @ basis, x @ inverse.T
    lift = np.concatenate([lift[:, :, :1], lift[:, :, 1:] @ inverse.T], axis=2)
    if cones is not None:
        # in another basis another cone is the second
        place = np.mod(np.rint(2 * x[cones]).astype(np.int64), 2)
        wanted = np.rint(2 * group.CONES).astype(np.int64)
        order = [int(np.flatnonzero((place == w).all(axis=1))[0]) for w in wanted]
        cones = cones[order]
    return _canonical(faces, lift, x, lattice, cones, tuple(log))


def _canonical(
    faces: np.ndarray,
    lift: np.ndarray,
    x: np.ndarray,
    lattice: np.ndarray,
    cones: np.ndarray | None,
    log: tuple[str, ...],
) -> Embedding:
    """With canonical coordinates in the domain, rounded, and checked."""
    x = group.rounded(x)
    x, gauge = group.into_domain(x, cones is not None)
    if cones is not None:
        at = group.inverse(gauge[cones])
        move = np.rint(2 * (x[cones] - group.CONES)).astype(np.int64) // 2
        gauge[cones] = group.inverse(at)
        gauge[cones, 1:] -= move
        x[cones] = group.CONES
    lift = group.compose(lift, group.inverse(gauge[faces]))
    lift = _near_domain(lift, x, faces, cones is not None)
    embedding = Embedding(faces, SIDE * x, lift, upright(lattice), cones, log)
    found = embedding.certificate()
    if not found.injective:
        flipped = number_of(int(found.flipped.sum()), "flipped triangle")
        raise NsmError(
            f"the embedding is not injective ({flipped})",
            kind="not_injective",
        )
    return embedding


def in_order(embedding: Embedding, cones: Sequence[int]) -> Embedding:
    """The same layout with its cones in another order: (0, 0), (1, 0), (1, 1), (0, 1).

    All 24 orders are there without another solve: an affine map of the lattice, x to B (x - c) with
    B in SL(2, Z) and c the first cone, takes one to the other. Of the matrices that do, the one is
    taken that leaves the lattice least sheared.

    Args:
        embedding: on an orbifold.
        cones: the embedding's four cones in the wanted order.

    Raises:
        NsmError: ``wrong_cones`` if they are not the embedding's.
    """
    if embedding.cones is None or sorted(cones) != sorted(embedding.cones.tolist()):
        raise NsmError("not the embedding's four cones", kind="wrong_cones", key="cones")
    corners = np.asarray(cones, dtype=np.int64)
    x = embedding.uv / SIDE
    origin = x[corners[0]]
    first, last = (np.mod(np.rint(2 * (x[corners[k]] - origin)).astype(int), 2) for k in (1, 3))
    basis = _with_columns(first, last)
    inverse = np.rint(np.linalg.inv(basis)).astype(np.int64)
    turns = np.rint((embedding.lift[:, :, :1] - 1) * origin).astype(np.int64)
    shift = (embedding.lift[:, :, 1:] + turns) @ inverse.T
    lift = np.concatenate([embedding.lift[:, :, :1], shift], axis=2)
    lattice = embedding.lattice @ basis
    return _finished(
        embedding.faces, lift, (x - origin) @ inverse.T, lattice, corners, True, [*embedding.log]
    )


def twisted(embedding: Embedding, basis: np.ndarray) -> Embedding:
    """The same layout in another basis of the lattice: another isotopy class of maps to it.

    Args:
        embedding: whatever domain.
        basis: (2, 2) integers with determinant 1, the new basis in coordinates of the old; on an
            orbifold the identity modulo 2, so that the cones stay. ((1, 2), (0, 1)) and
            ((1, 0), (2, 1)) generate these, up to sign: Dehn twists around two cones.

    Raises:
        NsmError: ``out_of_range`` for other matrices.
    """
    basis = np.asarray(basis, dtype=np.int64)
    even = embedding.cones is not None
    if round(np.linalg.det(basis)) != 1 or (even and (np.mod(basis, 2) != np.eye(2)).any()):
        raise NsmError("not a change of basis that keeps the cones", kind="out_of_range")
    inverse = np.rint(np.linalg.inv(basis)).astype(np.int64)
    lift = embedding.lift.copy()
    lift[:, :, 1:] = lift[:, :, 1:] @ inverse.T
    x = embedding.uv / SIDE @ inverse.T
    lattice = embedding.lattice @ basis
    return _canonical(embedding.faces, lift, x, lattice, embedding.cones, embedding.log)


def _with_columns(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """A matrix (2, 2) of small integers with determinant 1 and the given columns modulo 2."""
    for entries in product((-1, 0, 1), repeat=4):
        matrix = np.array(entries).reshape(2, 2)
        if matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0] != 1:
            continue
        if (np.mod(matrix, 2) == np.stack([first, last], axis=1)).all():
            return matrix
    raise AssertionError("two cones coincide")


def _near_domain(lift: np.ndarray, x: np.ndarray, faces: np.ndarray, symmetric: bool) -> np.ndarray:
    """Lifts (F, 3, 3) of each triangle such that its middle lies in the domain."""
    middle = group.moved(lift, x[faces]).mean(axis=1)
    _, element = group.into_domain(middle, symmetric)
    return group.compose(element[:, None], lift)


def reduced_basis(lattice: np.ndarray, even: bool = False) -> np.ndarray:
    """The integer matrix B (2, 2), of determinant 1, for which the columns of L B are short.

    Lagrange's reduction.

    Args:
        lattice: L (2, 2).
        even: only B that is the identity modulo 2, which leaves the cones in their order.
    """
    basis = np.eye(2, dtype=np.int64)
    step = 2 if even else 1
    for _ in range(200):
        a, b = (lattice @ basis).T
        if step * round(float(a @ b) / float(a @ a) / step):
            basis[:, 1] -= step * round(float(a @ b) / float(a @ a) / step) * basis[:, 0]
        elif step * round(float(a @ b) / float(b @ b) / step):
            basis[:, 0] -= step * round(float(a @ b) / float(b @ b) / step) * basis[:, 1]
        else:
            break
    return basis
