"""What is said of landmarks that do not fit each other, before any training and at its end."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.text import Text

from nsm.correspondence import Change, CoarseCheck, CommonAgreement, agreement, coarse_check
from nsm.domains import Surface
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.maps import AnalyticSurface
from nsm.pipeline.proposed_landmarks import ProposedLandmarks
from nsm.pipeline.resolve_inputs import Shape
from nsm.results import NeuralSurface
from nsm.results.landmark_picture import landmarks_picture
from nsm.stages import counted, stage
from nsm.surfaces.validation import NO_DECISION, Repairs

_HOW = (
    "Check that all lists have one order and that the numbers, from 0, are those of these files: "
    "landmarks.png of the run, or nsm landmarks, shows them"
)


@dataclass(frozen=True)
class LandmarkCheck:
    """How the landmarks of meshes fit each other.

    Attributes:
        names: of the meshes.
        landmarks: vertices (L,) of each mesh file.
        found: the agreement of their distances; None for too few.
        coarse: what coarse maps of the first mesh to others say, by the number of the other one.
    """

    names: Sequence[str]
    landmarks: Sequence[np.ndarray]
    found: CommonAgreement | None
    coarse: dict[int, CoarseCheck]

    @property
    def figures(self) -> dict[str, float | bool]:
        """Of a map's ``metrics``: ``landmark_correlation`` of distances, the least mean of a
        surface with the others, if there are enough; and whether the landmarks are doubted."""
        found = self.found
        known = {} if found is None else {"landmark_correlation": found.correlation(found.worst[0])}
        return {**known, "landmarks_doubtful": self.warning is not None}

    @property
    def cones(self) -> tuple[int, ...] | None:
        """The landmarks for the cones of two surfaces, where coarse maps prefer others than the
        surfaces' own layouts do (see :class:`nsm.correspondence.coarse_check.CoarseCheck`)."""
        only = list(self.coarse.values())
        return only[0].cones if len(self.names) == 2 and only else None

    @property
    def warning(self) -> Text | None:
        """One line in red, which names the landmark that fits least; None if there is no doubt.

        Distances are not asked where good coarse maps meet all landmarks. Where they hardly agree,
        one change of the landmarks is told only if it makes a good coarse map.
        """
        found, said = self.found, self._of_coarse_map()
        explained = any(one.explained for one in self.coarse.values())
        met = len(self.coarse) == len(self.names) - 1 and all(c.good for c in self.coarse.values())
        if found is not None and found.doubtful and not met:
            if said is None or (found.unrelated and not explained):
                said = self._of_distances(found)
        if said is None:
            return None
        end = ". A repair of the map may take long, and may leave it uncertified"
        return Text(f"WARNING: {said}. {_HOW}{end}", style="bold red")

    def _of_distances(self, found: CommonAgreement) -> str:
        surface, k = found.worst
        each = float(np.nanmean([one.each[k] for one in found.of(surface)]))
        if len(self.names) == 2:
            which = "the distances between them on both shapes are"
        else:
            which = f"those of {self.names[surface]} least: its distances and the others' are"
        return (
            f"the landmarks do not fit each other: {which} correlated by "
            f"{found.correlation(surface):.2f} (1 for like shapes), and by {each:.2f} for "
            f"{self._named(k, range(len(self.names)))}, which fits least"
        )

    def _of_coarse_map(self) -> str | None:
        """The change that coarse maps want most, and between which shapes; or that none helps."""
        wanted = [(one.best, k) for k, one in self.coarse.items() if one.best is not None]
        if not wanted:
            strained = [(one.energy, k) for k, one in self.coarse.items() if one.strained]
            if not strained:
                return None
            energy, k = max(strained)
            return (
                f"the landmarks do not fit the shapes: a coarse map of {self.names[0]} to "
                f"{self.names[k]} through all of them has the mean distortion {energy:.1f} (4 at "
                "best, 5 to 12 for like shapes)"
            )
        change, other = max(wanted, key=lambda entry: entry[0].excess)
        return _sentence(
            change,
            [self._named(k, (0, other)) for k in change.landmarks],
            (self.names[0], self.names[other]),
            self.coarse[other].energy,
        )

    def _named(self, k: int, meshes: Iterable[int]) -> str:
        """A landmark, and its vertices on meshes that have it."""
        vertices = [
            f"{self.landmarks[i][k]} of {self.names[i]}"
            for i in meshes
            if self.landmarks[i][k] >= 0
        ]
        return f"landmark {k} (vertex {', '.join(vertices)})"


def _sentence(change: Change, named: Sequence[str], names: tuple[str, str], energy: float) -> str:
    """What a coarse map says of landmarks."""
    source, target = names
    before = f"a coarse map of {source} to {target} through all landmarks has the mean distortion"
    after = f"{energy:.1f}, but {energy * np.exp(-change.gain):.1f}"
    if change.kind == "mirrored":
        return (
            f"the sides of {target} seem exchanged: {before} {after} if one shape is mirrored. "
            "Left and right differ in the two lists, or one mesh is inside out or a mirror image"
        )
    if change.kind == "exchanged":
        return f"two landmarks seem exchanged, {' and '.join(named)}: {before} {after} otherwise"
    return f"a landmark does not fit the others, {named[0]}: {before} {after} without it"


def check_landmarks(
    shapes: Sequence[Shape],
    landmarks: Sequence[np.ndarray],
    console: Console,
    repairs: Repairs = NO_DECISION,
    proposed: ProposedLandmarks | None = None,
) -> LandmarkCheck | None:
    """Compare landmarks on all meshes, and warn where they do not fit.

    The distances between them are compared on each two meshes, and closed meshes of genus 0 are
    mapped coarsely, the first to each other one (see :mod:`nsm.correspondence.coarse_check`).

    Args:
        shapes: two or more; analytic ones are not judged.
        landmarks: vertices (L,) of each.
        console: where to say it.
        repairs: decisions on meshes.
        proposed: what completes the landmarks. If none were given, coarse maps have proposed them,
            and say nothing new.

    Returns:
        None where nothing can be judged.
    """
    meshes = {k: mesh for k, shape in enumerate(shapes) if (mesh := _mesh(shape)) is not None}
    if len(meshes) < 2:
        return None
    names, ids = [meshes[k].name for k in meshes], [landmarks[k] for k in meshes]
    with stage(console, f"landmarks of {', '.join(names)}"):
        found = agreement([(mesh.vertices, mesh.faces) for mesh in meshes.values()], ids)
        some_given = proposed is None or proposed.given > 0
        coarse = _coarse_checks(list(meshes.values()), ids, repairs) if some_given else {}
    if found is None and not coarse:
        return None
    check = LandmarkCheck(names, ids, found, coarse)
    if check.warning is not None:
        console.print(check.warning, soft_wrap=True)
    return check


def _coarse_checks(
    meshes: Sequence[Mesh], landmarks: Sequence[np.ndarray], repairs: Repairs
) -> dict[int, CoarseCheck]:
    """What coarse maps of the first mesh to each other one say, where there are any."""
    try:
        cleaned = [mesh.cleaned(repairs) for mesh in meshes]
    except NsmError:  # refused, with its reason, where the meshes are prepared
        return {}
    arrays = [(mesh.vertices, mesh.faces) for mesh in cleaned]
    kept = [
        np.where(ids >= 0, mesh.merged[ids], -1)
        for mesh, ids in zip(cleaned, landmarks, strict=True)
    ]
    checks = {}
    for k in counted("coarse maps through landmarks", range(1, len(meshes))):
        both = np.flatnonzero((kept[0] >= 0) & (kept[k] >= 0))
        found = coarse_check(arrays[0], arrays[k], (kept[0][both], kept[k][both]))
        if found is not None:
            checks[k] = found.numbered(both)
    return checks


def draw_landmarks(
    folder: Path | None, surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray]
) -> None:
    """Leave ``landmarks.png`` in a run folder, if there is one, and landmarks; arguments as of
    :func:`nsm.results.landmark_picture.landmarks_picture`."""
    if folder is not None and len(landmarks[0]):
        folder.mkdir(parents=True, exist_ok=True)
        landmarks_picture(folder / "landmarks.png", surfaces, landmarks)


def _mesh(shape: Shape) -> Mesh | None:
    """What landmarks count the vertices of; None for an analytic surface."""
    if isinstance(shape, NeuralSurface):
        analytic = isinstance(shape.map, AnalyticSurface)
        return None if analytic else Mesh(shape.surface.name, *shape.file_mesh())
    return shape
