"""landmarks=auto: landmarks that nobody gave, and what is said and kept of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from nsm.correspondence import Proposal, proposed
from nsm.domains import DOMAINS, Domain
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline.resolve_inputs import Shape
from nsm.surfaces.landmark_files import to_json
from nsm.surfaces.validation import NO_DECISION, Repairs, clean

AUTO = "auto"


@dataclass(frozen=True)
class ProposedLandmarks:
    """A proposal in the numbers of the mesh files.

    Attributes:
        proposal: hypotheses, best first.
        pairs: of each hypothesis vertices (L, 2) of both files.
        chosen: the number of the hypothesis that is taken.
    """

    proposal: Proposal
    pairs: list[np.ndarray]
    chosen: int

    @property
    def landmarks(self) -> dict[str, list[int]]:
        """The landmarks that are taken, as the setting ``landmarks`` has them."""
        pairs = self.pairs[self.chosen]
        return {"source": pairs[:, 0].tolist(), "target": pairs[:, 1].tolist()}

    def to_json(self) -> str:
        """The landmarks as a file that can be corrected and given back, with the alternatives."""
        hypotheses = self.proposal.hypotheses
        others = [
            {"source": p[:, 0].tolist(), "target": p[:, 1].tolist(), "score": round(h.score, 4)}
            for k, (p, h) in enumerate(zip(self.pairs, hypotheses, strict=True))
            if k != self.chosen
        ]
        pairs = self.pairs[self.chosen]
        return to_json(
            [pairs[:, 0], pairs[:, 1]],
            None,
            score=round(hypotheses[self.chosen].score, 4),
            sure=self.proposal.sure,
            alternatives=others,
        )


def asks_for_proposal(landmarks: Any, shapes: Sequence[Shape], domain: Domain) -> bool:
    """Whether landmarks are to be proposed: they are ``auto``, or none are given for closed meshes
    of genus 0, on the orbifold."""
    if isinstance(landmarks, str):
        return landmarks == AUTO
    meshes = all(isinstance(shape, Mesh) for shape in shapes)
    return landmarks is None and meshes and domain == DOMAINS["orbifold"]


def propose_landmarks(
    shapes: Sequence[Shape],
    strict: bool,
    alternative: int,
    asked: bool,
    console: Console,
    repairs: Repairs = NO_DECISION,
) -> ProposedLandmarks | None:
    """Propose landmarks of two meshes, and say how sure they are.

    Args:
        shapes: source and target.
        strict: whether a proposal that is not sure is an error.
        alternative: which hypothesis is taken, 0 for the best.
        asked: whether the user asked for it; else a mesh that has no tips gives None.
        console: where to say it.
        repairs: the user's decisions on the meshes.

    Raises:
        NsmError: ``wrong_type``: a shape that is no mesh; ``unsure_landmarks``; ``out_of_range``:
            fewer alternatives; or as :func:`nsm.correspondence.proposed`.
    """
    meshes = []
    for shape in shapes:
        if not isinstance(shape, Mesh):
            raise NsmError(
                "landmarks=auto: source and target must be meshes, not neural surfaces or analytic "
                "ones; give mesh files or landmarks",
                kind="wrong_type",
                key="landmarks",
            )
        meshes.append(clean(shape.vertices, shape.faces, shape.name, repairs))
    source, target = meshes
    try:
        proposal = proposed((source.vertices, source.faces), (target.vertices, target.faces))
    except NsmError as error:
        if asked or strict:
            raise
        console.print(f"no landmarks are proposed: {error}", soft_wrap=True)
        return None
    found = proposal.hypotheses
    if alternative >= len(found):
        raise NsmError(
            f"proposal.alternative={alternative}: there are {len(found)} proposals; give a number "
            f"from 0 to {len(found) - 1}",
            kind="out_of_range",
            key="proposal.alternative",
        )
    ends = (source.source_vertex, target.source_vertex)
    pairs = [np.stack([ids[h.vertices[:, k]] for k, ids in enumerate(ends)], axis=1) for h in found]
    pairs = [own[(own >= 0).all(axis=1)] for own in pairs]  # not in the middle of filled holes
    line = _said(proposal, len(pairs[alternative]))
    if strict and not proposal.sure:
        raise NsmError(
            f"{line}; give landmarks, or leave proposal.strict out",
            kind="unsure_landmarks",
            key="proposal.strict",
        )
    if proposal.sure:
        console.print(line, soft_wrap=True)
    else:
        advice = "check landmarks.json of the run, or try proposal.alternative=1"
        warning = Text(f"WARNING: {line}; {advice}", style="yellow")
        console.print(warning, soft_wrap=True)
    return ProposedLandmarks(proposal, pairs, alternative)


def _said(proposal: Proposal, count: int) -> str:
    first = f"landmarks=auto: {count} pairs proposed"
    if len(proposal.hypotheses) == 1:
        ahead = "no different map among the best"
    else:
        ahead = f"{proposal.margin:.3f} ahead of the next different map, in log energy"
    sure = "sure" if proposal.sure else "NOT SURE"
    return f"{first}, {sure}: {ahead}; mean energy {proposal.hypotheses[0].energy:.2f}"
