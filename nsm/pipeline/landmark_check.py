"""What is said of landmarks that do not fit each other, before any training and at its end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.text import Text

from nsm.correspondence import CommonAgreement, agreement
from nsm.domains import Surface
from nsm.domains.joint_preparation import Mesh
from nsm.maps import AnalyticSurface
from nsm.pipeline.resolve_inputs import Shape
from nsm.results import NeuralSurface
from nsm.results.landmark_picture import landmarks_picture
from nsm.stages import stage


@dataclass(frozen=True)
class LandmarkCheck:
    """How the landmarks of meshes fit each other.

    Attributes:
        names: of the meshes.
        landmarks: vertices (L,) of each mesh file.
        found: their agreement.
    """

    names: Sequence[str]
    landmarks: Sequence[np.ndarray]
    found: CommonAgreement

    @property
    def figures(self) -> dict[str, float | bool]:
        """Of a map's ``metrics``: ``landmark_correlation`` of distances, the least mean of a
        surface with the others, and whether the landmarks are doubted."""
        return {
            "landmark_correlation": self.found.correlation(self.found.worst[0]),
            "landmarks_doubtful": self.found.doubtful,
        }

    @property
    def warning(self) -> Text | None:
        """One line in red, which names the landmark that fits least; None if there is no doubt."""
        if not self.found.doubtful:
            return None
        surface, k = self.found.worst
        own = self.found.of(surface)
        each = float(np.nanmean([one.each[k] for one in own]))
        correlation = self.found.correlation(surface)
        vertices = [
            f"{ids[k]} of {name}"
            for name, ids in zip(self.names, self.landmarks, strict=True)
            if ids[k] >= 0
        ]
        if len(self.names) == 2:
            which = "the distances between them on both shapes are"
        else:
            which = f"those of {self.names[surface]} least: its distances and the others' are"
        return Text(
            f"WARNING: the landmarks do not fit each other: {which} correlated by "
            f"{correlation:.2f} (1 for like shapes), and by {each:.2f} for landmark {k} (vertex "
            f"{', '.join(vertices)}), which fits least. Check that all lists have one order and "
            "that the numbers, from 0, are those of these files: landmarks.png of the run, or nsm "
            "landmarks, shows them",
            style="bold red",
        )


def check_landmarks(
    shapes: Sequence[Shape], landmarks: Sequence[np.ndarray], console: Console
) -> LandmarkCheck | None:
    """Compare the distances between landmarks on all meshes, and warn where they do not fit.

    Args:
        shapes: two or more; analytic ones are not judged.
        landmarks: vertices (L,) of each.
        console: where to say it.

    Returns:
        None where no two meshes have five landmarks in common.
    """
    meshes = {k: mesh for k, shape in enumerate(shapes) if (mesh := _mesh(shape)) is not None}
    if len(meshes) < 2:
        return None
    names, ids = [meshes[k].name for k in meshes], [landmarks[k] for k in meshes]
    with stage(console, f"landmarks of {', '.join(names)}"):
        found = agreement([(mesh.vertices, mesh.faces) for mesh in meshes.values()], ids)
    if found is None:
        return None
    check = LandmarkCheck(names, ids, found)
    if check.warning is not None:
        console.print(check.warning, soft_wrap=True)
    return check


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
