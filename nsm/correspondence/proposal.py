"""Correspondences of two closed surfaces without landmarks, and how sure they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsm.correspondence.coarse_shape import COMMON, CoarseShape, coarse_shape
from nsm.correspondence.distances import edge_distances
from nsm.correspondence.finer_maps import Mesh, finer_scores
from nsm.correspondence.further_ends import further_ends
from nsm.correspondence.mending import MENDING, mended
from nsm.correspondence.scores import score
from nsm.correspondence.search import NOTHING, Candidate, candidates, fixed_pairs
from nsm.errors import NsmError
from nsm.stages import at, counted
from nsm.surfaces import topology

# two maps differ if their images are this far apart in the mean, over √area, or if they take an end
# of a limb to ends of two limbs
_DIFFERENT = 0.2
_KEPT = 5
_NEAR = 0.1  # of a tip's image to the tip that corresponds to it, over √area
LEAST_LANDMARKS = 4  # for common cones
LEAST_MARGIN = 0.2
LARGEST_SCORE = 3.0


@dataclass(frozen=True)
class Hypothesis:
    """A correspondence that may be the right one.

    Attributes:
        vertices: (L, 2) corresponding vertices of source and target: landmarks that were given;
            of the best map, if it is sure, ends of limbs (:mod:`nsm.correspondence.further_ends`);
            tips that the map brings near to each other; cones of the orbifold that are no tips,
            only where the others are fewer than four.
        score: of the coarse map; lower is better. Of those that hardly differ, the best has the
            best score, and the others are as far behind as finer maps are.
        whole: whether all tips of one shape go to tips of the other; not asked where five landmarks
            or more were given.
        candidate: the coarse map.
    """

    vertices: np.ndarray
    score: float
    whole: bool
    candidate: Candidate

    @property
    def good(self) -> bool:
        """Whether the map may be right, were there no other."""
        return self.whole and self.score < LARGEST_SCORE


@dataclass(frozen=True)
class Proposal:
    """Hypotheses that differ from each other, best first.

    Attributes:
        hypotheses: one or more.
        margin: by how much the score of the second is above that of the first; or less, if it was
            less before finer maps were compared.
        given: how many landmarks were given; they come first in each hypothesis.
    """

    hypotheses: list[Hypothesis]
    margin: float
    given: int = 0

    @property
    def sure(self) -> bool:
        """Whether the first is far ahead of the second, and good in itself."""
        return self.margin > LEAST_MARGIN and self.hypotheses[0].good


def proposed(
    source: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    given: np.ndarray = NOTHING,
) -> Proposal:
    """Propose correspondences of two closed surfaces of genus 0, without reflections.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        given: (G, 2) corresponding vertices of both, which are kept and completed.

    Raises:
        NsmError: ``wrong_topology`` or ``no_proposal``, see
            :func:`nsm.correspondence.coarse_shape.coarse_shape` and
            :func:`nsm.correspondence.search.candidates`.
    """
    meshes = (source, target)
    shapes = [coarse_shape(*mesh, fixed=given[:, k]) for k, mesh in enumerate(meshes)]
    kept = hypotheses(*shapes)
    margin = _margin(kept)
    if len(given) >= COMMON:
        # these tell where the map goes: limbs that are left say nothing against it
        kept[0] = replace(kept[0], whole=True)
    elif margin <= LEAST_MARGIN:
        kept = _told_apart(kept, meshes)
    found = Proposal(kept, min(margin, _margin(kept)), len(given))
    if found.sure and len(kept[0].vertices) >= COMMON:
        kept[0] = _completed(kept[0], given, meshes)
    return found


def _margin(kept: list[Hypothesis]) -> float:
    return kept[1].score - kept[0].score if len(kept) > 1 else np.inf


def _completed(best: Hypothesis, given: np.ndarray, meshes: tuple[Mesh, Mesh]) -> Hypothesis:
    """The hypothesis with those ends of limbs that a map through its landmarks meets at little
    cost; without them where the finer shapes have no layout.

    Given landmarks, if they are five or more, decide alone; tips come after the ends.
    """
    at("ends of limbs")
    known = given if len(given) >= COMMON else best.vertices
    try:
        more = further_ends(meshes, known)
    except NsmError:
        return best
    tips = best.vertices[len(known) :]
    for k, (vertices, faces) in enumerate(meshes):
        if len(more) and len(tips):
            apart = edge_distances(vertices, faces, more[:, k])[:, tips[:, k]].min(axis=0)
            area = topology.face_areas(vertices, faces).sum()
            tips = tips[apart > _NEAR * np.sqrt(area)]
    return replace(best, vertices=np.concatenate([known, more, tips]))


def _told_apart(kept: list[Hypothesis], meshes: tuple[Mesh, Mesh]) -> list[Hypothesis]:
    """Hypotheses, best first, those that are nearly as good as the first in the order of finer
    maps."""
    near = [h for h in kept if h.score <= kept[0].score + LEAST_MARGIN]
    at("finer maps")
    scores = told_apart(near, meshes)
    better = [replace(h, score=float(value)) for h, value in zip(near, scores, strict=True)]
    others = [h for h in kept if all(h is not one for one in near)]
    return sorted([*better, *others], key=lambda h: h.score)


def told_apart(near: Sequence[Hypothesis], meshes: tuple[Mesh, Mesh]) -> np.ndarray:
    """The scores (H,) of hypotheses that hardly differ: the best one's, and by how much finer maps
    of the meshes are behind the best of these.

    They stay as they are where finer maps cannot be compared.
    """
    own = np.array([h.score for h in near])
    scores = finer_scores(meshes, [h.candidate for h in near], [h.vertices for h in near])
    return own.min() + scores - scores.min() if np.isfinite(scores).all() else own


def hypotheses(source: CoarseShape, target: CoarseShape) -> list[Hypothesis]:
    """Correspondences of two coarse shapes that differ from each other, best first."""
    found = candidates(source, target)
    for one in counted("tips drawn together", MENDING):
        found = mended(found, one)
    kept: list[Hypothesis] = []
    for hypothesis in sorted(map(_hypothesis, found), key=lambda h: h.score):
        if len(kept) < _KEPT and all(_differ(hypothesis, other) for other in kept):
            kept.append(hypothesis)
    return kept


def _hypothesis(candidate: Candidate) -> Hypothesis:
    pairs = _matched_tips(candidate)
    ids = candidate.source.shape.ids[pairs[:, 0]], candidate.target.shape.ids[pairs[:, 1]]
    fewer = min(len(candidate.source.shape.peaks()), len(candidate.target.shape.peaks()))
    whole = len(_tips_brought_together(candidate)) == fewer
    return Hypothesis(np.stack(ids, axis=1), score(candidate), whole, candidate)


def _matched_tips(candidate: Candidate) -> np.ndarray:
    """Vertices (L, 2) of the coarse shapes: given landmarks; tips that are brought together; other
    cones, up to four in all. None is near a given landmark, which says the same."""
    pairs = _away(candidate, _tips_brought_together(candidate))
    pairs = np.concatenate([fixed_pairs(candidate), pairs])
    cones = candidate.cones()
    others = _away(candidate, cones[~np.isin(cones[:, 0], pairs[:, 0])])
    return np.concatenate([pairs, others[: max(LEAST_LANDMARKS - len(pairs), 0)]])


def _tips_brought_together(candidate: Candidate) -> np.ndarray:
    """Tips (L, 2) at the cones of both, then others whose images are mutually nearest."""
    source, target = candidate.source.shape, candidate.target.shape
    ours, theirs, cones = source.peaks(), target.peaks(), candidate.cones()
    pairs = cones[np.isin(cones[:, 0], ours) & np.isin(cones[:, 1], theirs)]
    ours, theirs = np.setdiff1d(ours, cones[:, 0]), np.setdiff1d(theirs, cones[:, 1])
    if not len(ours) or not len(theirs):
        return pairs
    apart = target.distance[np.ix_(candidate.images(ours), theirs)]
    nearest = apart.argmin(axis=1)
    rows = np.arange(len(ours))
    mutual = (apart.argmin(axis=0)[nearest] == rows) & (apart[rows, nearest] < _NEAR)
    return np.concatenate([pairs, np.stack([ours, theirs[nearest]], axis=1)[mutual]])


def _away(candidate: Candidate, pairs: np.ndarray) -> np.ndarray:
    """Those of pairs (L, 2) of which neither end is near a given landmark."""
    keep = np.ones(len(pairs), dtype=bool)
    for k, shape in enumerate((candidate.source.shape, candidate.target.shape)):
        apart = shape.distance[np.ix_(pairs[:, k], shape.fixed)]
        keep &= apart.min(axis=1, initial=np.inf) > _NEAR
    return pairs[keep]


def _differ(first: Hypothesis, second: Hypothesis) -> bool:
    """Whether two maps of the same shapes are different hypotheses."""
    shape, target = first.candidate.source.shape, first.candidate.target.shape
    a, b = (h.candidate.images(shape.samples) for h in (first, second))
    if float(target.distance[a, b].mean()) > _DIFFERENT:
        return True
    ours, theirs = (dict(_tips_brought_together(h.candidate).tolist()) for h in (first, second))
    return any(ours[v] != theirs[v] for v in ours.keys() & theirs.keys())
