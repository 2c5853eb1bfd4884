"""Landmarks that nobody gave, or that complete those given, and what is said and kept of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.console import Console
from rich.text import Text

from nsm.correspondence import proposed, proposed_for_all
from nsm.domains import Automatic, Domain
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline.configured_surface import configured_repairs
from nsm.pipeline.landmark_inputs import landmark_vertices, name_of
from nsm.pipeline.landmark_places import as_places, with_places
from nsm.pipeline.resolve_inputs import Shape
from nsm.stages import stage
from nsm.surfaces.landmark_files import to_json
from nsm.surfaces.landmarks import kept_landmarks
from nsm.surfaces.topology import genus_and_boundary
from nsm.surfaces.validation import CleanMesh
from nsm.wording import number_of

AUTO = "auto"
_ENOUGH = 4  # landmarks for common cones, completed only by sure ones
_COMPLETED = 8  # landmarks at most that are completed by others


@dataclass(frozen=True)
class ProposedLandmarks:
    """Proposals in the numbers of the mesh files.

    Attributes:
        vertices: of each hypothesis (L, k), best first; the given landmarks before the others.
        scores: of each; lower is better.
        margin: how far the first is ahead, in log energy.
        sure: whether that is enough; an alternative is never sure.
        given: how many landmarks were given.
        chosen: the number of the hypothesis that is taken.
        places: of each mesh the faces (F, 3) of its file and the places (G, 4) of given landmarks,
            if they are places.
    """

    vertices: list[np.ndarray]
    scores: list[float]
    margin: float
    sure: bool
    given: int
    chosen: int
    places: Sequence[tuple[np.ndarray, np.ndarray] | None] = ()

    @property
    def landmarks(self) -> list[np.ndarray]:
        """The landmarks (L,) that are taken, of each surface."""
        return list(self.vertices[self.chosen].T)

    @property
    def added(self) -> int:
        """How many landmarks are taken beside those given."""
        return len(self.vertices[self.chosen]) - self.given

    def to_json(self) -> str:
        """The landmarks as a file that can be corrected and given back, with the alternatives."""
        others = [
            {**_named(self._written(rows)), "score": round(score, 4)}
            for k, (rows, score) in enumerate(zip(self.vertices, self.scores, strict=True))
            if k != self.chosen
        ]
        return to_json(
            self._written(self.vertices[self.chosen]),
            None,
            given=self.given,
            score=round(self.scores[self.chosen], 4),
            sure=self.sure,
            alternatives=others,
        )

    def _written(self, rows: np.ndarray) -> list[np.ndarray]:
        """Landmarks (L, k) as the mesh files have them: without the vertices made for places."""
        places = self.places or [None] * rows.shape[1]
        return [
            one if known is None else as_places(one, *known)
            for one, known in zip(rows.T, places, strict=True)
        ]

    @property
    def said(self) -> str:
        """What was given, what is proposed, and how sure that is."""
        kept = f"{self.given} given are kept, " if self.given else ""
        if self.chosen:
            behind = self.scores[self.chosen] - self.scores[0]
            ahead = f"alternative {self.chosen}, {behind:.3f} behind the best map, in log energy"
        elif np.isfinite(self.margin):
            ahead = f"{self.margin:.3f} ahead of the next different map, in log energy"
        else:
            ahead = "no different map among the best"
        sure = "sure" if self.sure else "NOT SURE"
        return f"landmarks: {kept}{self.added} proposed, {sure}: {ahead}"

    @property
    def figures(self) -> dict[str, bool]:
        """Of a map's ``metrics``: whether the landmarks are sure."""
        return {"landmarks_sure": self.sure}

    @property
    def warning(self) -> Text | None:
        """One line for landmarks that are not sure; None for others."""
        if self.sure:
            return None
        other = 0 if self.chosen else 1
        advice = f"check landmarks.json of the run, or try proposal.alternative={other}"
        return Text(f"WARNING: {self.said}; {advice}", style="yellow")


def given_or_proposed(
    landmarks: Any,
    shapes: Sequence[Shape],
    domain: Domain,
    config: DictConfig,
    console: Console,
    exact: bool = True,
    template: bool = False,
) -> tuple[list[Shape], list[np.ndarray], ProposedLandmarks | None]:
    """The landmarks of a map: those given, those proposed, or both.

    Landmarks are proposed if they are ``auto``; and for closed meshes, on the domain that suits
    them, if none are given, or one to eight, which are completed; of meshes with handles for two,
    and up to four. Four are enough for common cones: unsure ones do not come to them.

    Args:
        landmarks: as :func:`nsm.pipeline.landmark_inputs.landmark_vertices` takes them, or
            ``auto``.
        shapes: two or more.
        domain: of the map.
        config: of the run: its ``proposal`` and the decisions on meshes.
        console: where to say it.
        exact: landmarks that are places in triangles become vertices; else the nearest vertex
            stands for each.
        template: as for :func:`nsm.pipeline.landmark_inputs.landmark_vertices`.

    Returns:
        the shapes, with these vertices; the landmarks as vertices (L,) of each; and the proposal if
        there is one.

    Raises:
        NsmError: ``wrong_type``: ``auto`` for a shape that is no mesh; ``unsure_landmarks``, with
            ``proposal.strict``; ``out_of_range``: fewer alternatives; or as
            :func:`nsm.correspondence.proposed` and
            :func:`nsm.pipeline.landmark_inputs.landmark_vertices`.
    """
    settings = config.proposal
    asked = isinstance(landmarks, str) and landmarks == AUTO
    meshes = [shape for shape in shapes if isinstance(shape, Mesh)]
    if asked and len(meshes) < len(shapes):
        raise NsmError(
            "landmarks=auto: all surfaces must be meshes, not neural surfaces or analytic ones; "
            "give mesh files or landmarks",
            kind="wrong_type",
            key="landmarks",
        )
    if asked:
        landmarks = None
    none = landmarks is None
    known: list[tuple[np.ndarray, np.ndarray] | None] = [None] * len(shapes)
    if exact and not none:
        files = shapes
        shapes, landmarks, places = with_places(landmarks, files, console, template=template)
        known = [
            (file.faces, one) if isinstance(file, Mesh) and one is not None else None
            for file, one in zip(files, places, strict=True)
        ]
    meshes = [shape for shape in shapes if isinstance(shape, Mesh)]
    told = exact and not none
    ids = landmark_vertices(landmarks, shapes, console, template=template, told=told)
    repairs = configured_repairs(config)
    if len(ids[0]):
        with stage(console, f"landmarks of {', '.join(name_of(shape) for shape in shapes)}"):
            for shape, own in zip(shapes, ids, strict=True):
                if isinstance(shape, Mesh):
                    kept_landmarks(shape.cleaned(repairs), own, shape.name)
    some_lack = any((of_one < 0).any() for of_one in ids)
    few = settings.complete and 1 <= len(ids[0]) <= _COMPLETED and not some_lack
    possible = len(meshes) == len(shapes)
    if not (asked or (possible and (none or few))):
        return list(shapes), ids, None
    cleaned = [mesh.cleaned(repairs) for mesh in meshes]
    if not asked and not _proposed_for(cleaned, domain, len(ids[0])):
        return list(shapes), ids, None
    what = "landmarks" if none else "further landmarks"
    with stage(console, f"proposing {what} of {', '.join(mesh.name for mesh in meshes)}"):
        try:
            found = _proposal(cleaned, ids, settings.alternative)
        except NsmError as error:
            needed = settings.strict and len(ids[0]) < _ENOUGH
            if asked or needed or error.key == "proposal.alternative":
                raise
            console.print(f"no landmarks are proposed: {error}", soft_wrap=True)
            return list(shapes), ids, None
    if len(ids[0]) >= _ENOUGH and not settings.alternative:
        if not found.sure:
            console.print(
                f"landmarks: {len(ids[0])} given are kept; no others are sure enough to come to "
                "them",
                soft_wrap=True,
            )
        if not (found.sure and found.added):
            return list(shapes), ids, None
    if settings.strict and not found.sure:
        raise NsmError(
            f"{found.said}; give landmarks, or leave proposal.strict out",
            kind="unsure_landmarks",
            key="proposal.strict",
        )
    console.print(found.said if found.warning is None else found.warning, soft_wrap=True)
    return list(shapes), found.landmarks, replace(found, places=known)


def _proposed_for(meshes: Sequence[CleanMesh], domain: Domain, given: int) -> bool:
    """Whether landmarks are proposed though they were not asked for: for closed meshes on the
    domain that suits them, and where surfaces have handles, for two of them with few landmarks."""
    topologies = {genus_and_boundary(mesh.faces) for mesh in meshes}
    if len(topologies) > 1 or Automatic().chosen(topologies) != domain:
        return False
    ((genus, loops),) = topologies
    return not loops and (not genus or (len(meshes) == 2 and given <= _ENOUGH))


def _proposal(
    meshes: Sequence[CleanMesh], ids: Sequence[np.ndarray], alternative: int
) -> ProposedLandmarks:
    """Hypotheses for cleaned meshes, as vertices of their files.

    Raises:
        NsmError: ``out_of_range``, with the key ``proposal.alternative``; or as
            :func:`nsm.correspondence.proposed`.
    """
    arrays = [(mesh.vertices, mesh.faces) for mesh in meshes]
    given = np.stack([m.merged[k] for m, k in zip(meshes, ids, strict=True)], axis=1)
    if len(meshes) == 2:
        pair = proposed(arrays[0], arrays[1], given)
        rows = [h.vertices for h in pair.hypotheses]
        scores, margin, sure = [h.score for h in pair.hypotheses], pair.margin, pair.sure
    else:
        every = proposed_for_all(arrays, given)
        rows, scores, margin, sure = every.vertices, every.scores, every.margin, every.sure
    if alternative >= len(rows):
        raise NsmError(
            f"proposal.alternative={alternative}: of {number_of(len(rows), 'proposal')}; give a "
            f"number from 0 to {len(rows) - 1}",
            kind="out_of_range",
            key="proposal.alternative",
        )
    numbers = [
        np.stack([mesh.source_vertex[row] for mesh, row in zip(meshes, one.T, strict=True)], axis=1)
        for one in rows
    ]
    # not in the middle of filled holes
    numbers = [one[(one >= 0).all(axis=1)] for one in numbers]
    for one in numbers:  # a vertex that was merged with another keeps its number
        one[: len(ids[0])] = np.stack(ids, axis=1)
    return ProposedLandmarks(
        numbers, scores, margin, sure and not alternative, len(ids[0]), alternative
    )


def _named(lists: Sequence[np.ndarray]) -> dict[str, Any]:
    plain = [one.tolist() for one in lists]
    if len(plain) == 2:
        return {"source": plain[0], "target": plain[1]}
    return {"landmarks": plain}
