"""Correspondences of two closed surfaces without landmarks, and how sure they are.

Surfaces with handles are cut open around these, which leaves surfaces of genus 0: the source in one
way, the target in several, of which the maps' scores tell the right one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsm.correspondence.coarse_shape import COMMON, CoarseShape, coarse_shape
from nsm.correspondence.distances import edge_distances
from nsm.correspondence.finer_maps import finer_scores
from nsm.correspondence.further_ends import further_ends
from nsm.correspondence.mending import MENDING, mended
from nsm.correspondence.scores import score
from nsm.correspondence.search import NOTHING, Candidate, candidates, fixed_pairs
from nsm.correspondence.whole_surfaces import has_handles, on_whole, opened_shapes
from nsm.errors import NsmError
from nsm.stages import at, counted
from nsm.surfaces import topology

# two maps differ if their images are this far apart in the mean, over √area, or if they take an end
# of a limb to ends of two limbs
_DIFFERENT = 0.2
_KEPT = 5
_HANDLES = 2  # of more, too few ways to cut them open are tried to be sure
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
            or more were given; False for surfaces with three handles or more.
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
    """Propose correspondences of two closed surfaces of one genus, without reflections.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        given: (G, 2) corresponding vertices of both, which are kept and completed.

    Raises:
        NsmError: ``wrong_topology`` or ``no_proposal``, see
            :func:`nsm.correspondence.coarse_shape.coarse_shape`,
            :func:`nsm.correspondence.opened_handles.ways_to_open` and
            :func:`nsm.correspondence.search.candidates`.
    """
    handles = has_handles(source) and has_handles(target)
    if handles:
        kept = hypotheses(*opened_shapes(source, target, given))
        if topology.genus_and_boundary(source[1])[0] > _HANDLES:
            kept = [replace(h, whole=False) for h in kept]
    else:
        shapes = [coarse_shape(*m, fixed=given[:, k]) for k, m in enumerate((source, target))]
        kept = hypotheses(shapes[0], shapes[1:])
    margin = _margin(kept)
    if len(given) >= COMMON:
        # these tell where the map goes: limbs that are left say nothing against it
        kept[0] = replace(kept[0], whole=True)
    elif margin <= LEAST_MARGIN:
        kept = _told_apart(kept)
    found = Proposal(kept, min(margin, _margin(kept)), len(given))
    if found.sure and len(kept[0].vertices) >= COMMON:
        kept[0] = _completed(kept[0], given)
    if not handles:
        return found
    meshes = (source, target)
    closed = [
        replace(one, vertices=on_whole(one.candidate, one.vertices, LEAST_LANDMARKS, meshes))
        for one in kept
    ]
    return replace(found, hypotheses=closed)


def _margin(kept: list[Hypothesis]) -> float:
    return kept[1].score - kept[0].score if len(kept) > 1 else np.inf


def _completed(best: Hypothesis, given: np.ndarray) -> Hypothesis:
    """The hypothesis with ends of limbs, see :func:`completed`."""
    at("ends of limbs")
    shapes = best.candidate.source.shape, best.candidate.target.shape
    meshes = [shape.mesh.arrays for shape in shapes]
    return replace(best, vertices=completed(best.vertices, len(given), meshes, 0, [1]))


def completed(
    rows: np.ndarray,
    given: int,
    meshes: Sequence[tuple[np.ndarray, np.ndarray]],
    hub: int,
    others: Iterable[int],
) -> np.ndarray:
    """Landmarks with those ends of limbs that maps through them meet at little cost; as they are
    where the finer shapes have no layout.

    Given landmarks, if they are five or more, decide alone; tips come after the ends.

    Args:
        rows: (L, k) vertices of k meshes, the given ones first.
        given: how many of the rows were given.
        meshes: vertices (V, 3) and faces (F, 3) of each.
        hub: the mesh whose ends are matched with those of each other one.
        others: the other meshes; ends come in that correspond to ends of all of them.
    """
    known = rows[:given] if given >= COMMON else rows
    ends: dict[int, dict[int, int]] = {}
    for i in others:
        try:
            pairs = further_ends((meshes[hub], meshes[i]), known[:, [hub, i]])
        except NsmError:
            return rows
        ends[i] = dict(pairs.tolist())
    first, *rest = ends.values()
    of_all = [v for v in first if all(v in found for found in rest)]
    found = [[v if i == hub else ends[i][v] for i in range(len(meshes))] for v in of_all]
    more = np.array(found, dtype=np.int64).reshape(-1, len(meshes))
    tips = rows[len(known) :]
    for k, (vertices, faces) in enumerate(meshes):
        if len(more) and len(tips):
            apart = edge_distances(vertices, faces, more[:, k])[:, tips[:, k]].min(axis=0)
            area = topology.face_areas(vertices, faces).sum()
            tips = tips[apart > _NEAR * np.sqrt(area)]
    return np.concatenate([known, more, tips])


def _told_apart(kept: list[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses, best first, those that are nearly as good as the first in the order of finer
    maps."""
    near = [h for h in kept if h.score <= kept[0].score + LEAST_MARGIN]
    at("finer maps")
    scores = told_apart(near)
    better = [replace(h, score=float(value)) for h, value in zip(near, scores, strict=True)]
    others = [h for h in kept if all(h is not one for one in near)]
    return sorted([*better, *others], key=lambda h: h.score)


def told_apart(near: Sequence[Hypothesis]) -> np.ndarray:
    """The scores (H,) of hypotheses that hardly differ: the best one's, and by how much finer maps
    are behind the best of these.

    They stay as they are where finer maps cannot be compared.
    """
    own = np.array([h.score for h in near])
    scores = finer_scores([h.candidate for h in near], [h.vertices for h in near])
    return own.min() + scores - scores.min() if np.isfinite(scores).all() else own


def hypotheses(source: CoarseShape, targets: Sequence[CoarseShape]) -> list[Hypothesis]:
    """Correspondences of coarse shapes that differ from each other, best first; several targets are
    one surface, cut open in several ways."""
    found = candidates(source, targets)
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
    cones, up to four in all, but for handles cut open. None is near a given landmark, which says
    the same."""
    pairs = _away(candidate, _tips_brought_together(candidate))
    pairs = np.concatenate([fixed_pairs(candidate), pairs])
    if len(candidate.source.shape.mesh.caps):  # see nsm.correspondence.whole_surfaces
        return pairs
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
    if second.candidate.target.shape.mesh is not target.mesh:
        return _differ_uncut(first, second)
    if float(target.distance[a, b].mean()) > _DIFFERENT:
        return True
    ours, theirs = (dict(_tips_brought_together(h.candidate).tolist()) for h in (first, second))
    return any(ours[v] != theirs[v] for v in ours.keys() & theirs.keys())


def _differ_uncut(first: Hypothesis, second: Hypothesis) -> bool:
    """The same for maps to one surface that was cut open in two ways; caps do not count."""
    ours, theirs = (_tips_on_whole(h) for h in (first, second))
    both = sorted(ours.keys() & theirs.keys())
    ends = []
    for hypothesis, tips in ((first, ours), (second, theirs)):
        target = hypothesis.candidate.target.shape
        images = hypothesis.candidate.images(hypothesis.candidate.source.shape.samples)
        ends.append([*target.mesh.origin[target.ids[images]].tolist(), *(tips[v] for v in both)])
    vertices, faces = first.candidate.target.shape.mesh.whole
    distance = edge_distances(vertices, faces, np.array(ends[0]))
    apart = distance[np.arange(len(ends[0])), ends[1]]
    apart /= np.sqrt(topology.face_areas(vertices, faces).sum())
    tips_apart = apart[len(apart) - len(both) :]
    images_apart = apart[: len(apart) - len(both)]
    return bool(images_apart.mean() > _DIFFERENT or (tips_apart > _NEAR).any())


def _tips_on_whole(hypothesis: Hypothesis) -> dict[int, int]:
    """Of tips of the source that are brought to a tip, neither a cap, that tip: a vertex of the
    target before it was cut."""
    source, target = hypothesis.candidate.source.shape, hypothesis.candidate.target.shape
    pairs = _tips_brought_together(hypothesis.candidate)
    caps = [np.isin(s.ids[pairs[:, k]], s.mesh.caps) for k, s in enumerate((source, target))]
    ours, theirs = pairs[~caps[0] & ~caps[1]].T
    return dict(zip(ours.tolist(), target.mesh.origin[target.ids[theirs]].tolist(), strict=True))
