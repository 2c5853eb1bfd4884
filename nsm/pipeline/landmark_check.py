"""What is said of landmarks that do not fit each other, before any training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.text import Text

from nsm.correspondence import agreement
from nsm.domains.joint_preparation import Mesh
from nsm.pipeline.resolve_inputs import Shape
from nsm.stages import stage


def warn_of_landmarks(
    shapes: Sequence[Shape], landmarks: Sequence[np.ndarray], console: Console
) -> bool:
    """Warn, in red, of landmarks whose distances on two meshes do not fit each other.

    Args:
        shapes: source and target; any but meshes are not judged.
        landmarks: vertices (L,) of both.
        console: where to say it.

    Returns:
        Whether there was a warning.
    """
    source, target = shapes
    if not (isinstance(source, Mesh) and isinstance(target, Mesh)):
        return False
    with stage(console, f"landmarks of {source.name}, {target.name}"):
        found = agreement([(m.vertices, m.faces) for m in (source, target)], landmarks)
    if found is None or not found.doubtful:
        return False
    k = found.worst
    warning = (
        "WARNING: the landmarks do not fit each other: the distances between them on both shapes "
        f"are correlated by {found.correlation:.2f} (1 for like shapes), and by "
        f"{found.each[k]:.2f} for landmark {k} (vertex {landmarks[0][k]} of {source.name}, "
        f"{landmarks[1][k]} of {target.name}), which fits least. Check that both lists have one "
        "order and that the numbers, from 0, are those of these files: landmarks.png of the run, "
        "or nsm landmarks, shows them"
    )
    console.print(Text(warning, style="bold red"), soft_wrap=True)
    return True
