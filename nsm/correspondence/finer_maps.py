"""Maps that coarse shapes hardly tell apart, made and compared once more on finer shapes.

A thousand triangles leave little of a nose or of feet, and these may be all that tells the front of
a shape from its back.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape, coarse_shape
from nsm.correspondence.layouts import Layout, Table, affine_maps, layout, table
from nsm.correspondence.scores import score
from nsm.correspondence.search import Candidate, Round, trained

FACES = 2500
ROUNDS = (Round(0, 8, 30), Round(0, 12, 40))  # with tips drawn together, and then let go


def finer_scores(found: Sequence[Candidate], drawn: Sequence[np.ndarray]) -> np.ndarray:
    """The scores (H,) of coarse maps, made anew on finer shapes; lower is better.

    Of each map the cones stay where they are, and all isotopy classes that are likely with these
    are tried.

    Args:
        found: coarse maps of one source.
        drawn: of each the corresponding vertices (L, 2) of its shapes' meshes, tips of both, that
            are drawn together.

    Returns:
        inf where the layout of a finer shape lacks digits.
    """
    source = _finer(found[0].source.shape)
    targets: dict[int, CoarseShape] = {}
    ours: dict[bytes, Layout | None] = {}
    theirs: dict[tuple[int, bytes], tuple[Layout, Table] | None] = {}
    starts: list[Candidate] = []
    number: list[int] = []
    pairs: list[np.ndarray] = []
    for k, (one, ids) in enumerate(zip(found, drawn, strict=True)):
        of_target = id(one.target.shape)
        if of_target not in targets:
            targets[of_target] = _finer(one.target.shape)
        target = targets[of_target]
        first, second = one.source.tips.tobytes(), (of_target, one.target.tips.tobytes())
        if first not in ours:
            ours[first] = layout(source, one.source.tips)
        if second not in theirs:
            made = layout(target, one.target.tips)
            theirs[second] = None if made is None else (made, table(made))
        a, b = ours[first], theirs[second]
        if a is None or b is None:
            continue
        ends = (source, ids[:, 0]), (target, ids[:, 1])
        both = np.stack([np.searchsorted(s.ids, end) for s, end in ends], axis=1)
        for start in _starts(one, a, *b):
            starts.append(start)
            number.append(k)
            pairs.append(both)
    scores = np.full(len(found), np.inf)
    if starts:
        done = trained(starts, ROUNDS[0], drawn=pairs)
        done = trained(done, ROUNDS[1], held=True)
        np.minimum.at(scores, number, [score(one) for one in done])
    return scores


def _finer(shape: CoarseShape) -> CoarseShape:
    tips = shape.ids[shape.tips]
    fixed = tips[: shape.given]
    return coarse_shape(*shape.mesh.arrays, tips, fixed, FACES, shape.mesh)


def _starts(one: Candidate, a: Layout, b: Layout, looked_up: Table) -> list[Candidate]:
    """The affine maps that take the same cones to each other as a map does."""
    wanted = set(map(tuple, one.cone_numbers().tolist()))
    made = [
        Candidate(a, b, looked_up, matrix, shift, 0, np.zeros((0, 2)), 0.0)
        for matrix, shift in affine_maps(a, b)
    ]
    return [c for c in made if set(map(tuple, c.cone_numbers().tolist())) == wanted]
