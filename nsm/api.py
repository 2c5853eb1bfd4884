"""The public Python API: the words of the command line, as functions."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from nsm.config import compose_config
from nsm.pipeline import run_overfit
from nsm.results import NeuralSurface, load_surface
from nsm.surfaces import Surface


def overfit(
    surface: Surface,
    *,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
) -> NeuralSurface:
    """Train a network to be the surface.

    Args:
        surface: the prepared surface.
        overrides: settings as on the command line, e.g. ``["trainer.max_steps=1000"]``.
        folder: where to leave the run's files; without it they are not kept.
        progress: show a progress bar.

    Returns:
        The neural surface φ with its figures in ``metrics``.

    Raises:
        NsmError: a setting that does not exist or cannot be used.

    Examples:
        >>> phi = nsm.overfit(nsm.Surface.load("terrain"), overrides=["experiment=quick"])
        >>> phi(uv)  # (N, 2) points of Ω to (N, 3)
    """
    words = [*overrides, f"domain={surface.domain}"]
    if not progress:
        words.append("trainer.progress=false")
    if folder is not None:
        return run_overfit(compose_config(words), Path(folder), surface=surface)
    with tempfile.TemporaryDirectory(prefix="nsm-") as temporary:
        quiet = [*words, "logger=none"]
        return run_overfit(compose_config(quiet), Path(temporary), surface=surface)


def load(folder: str | Path) -> NeuralSurface:
    """Give back the result of a run.

    Args:
        folder: the run folder, or its ``surface.safetensors``.

    Raises:
        NsmError: nothing there, or a file that is damaged or of another version.
    """
    return load_surface(folder)
