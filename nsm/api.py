"""The public Python API: the words of the command line, as functions."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from omegaconf import DictConfig

from nsm.config import compose_config
from nsm.pipeline import run_overfit, run_param
from nsm.results import NeuralSurface, Parameterization, load_parameterization, load_surface
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
    words = ["task=overfit", *overrides, f"domain={surface.domain}"]
    with _place(folder, words, progress) as (config, place):
        return run_overfit(config, place, surface)


def parameterize(
    phi: NeuralSurface,
    *,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
) -> Parameterization:
    """Flatten a neural surface to the plane with least distortion and a free boundary.

    Args:
        phi: the neural surface.
        overrides: settings as on the command line, e.g. ``["energy=conformal"]``.
        folder: where to leave the run's files; without it they are not kept.
        progress: show a progress bar.

    Returns:
        The map with its new coordinates in ``uv``, and its figures beside those of libigl's
        methods in ``metrics``.

    Raises:
        NsmError: a setting that does not exist or cannot be used.

    Examples:
        >>> flat = nsm.parameterize(phi)
        >>> flat.uv  # (V, 2), of the cut mesh's vertices
    """
    words = ["task=param", *overrides, f"domain={phi.surface.domain}"]
    with _place(folder, words, progress) as (config, place):
        return run_param(config, place, phi)


@contextmanager
def _place(
    folder: str | Path | None, words: list[str], progress: bool
) -> Iterator[tuple[DictConfig, Path]]:
    """The configuration, and the run folder: a passing one, without logs, if none is given."""
    if not progress:
        words = [*words, "trainer.progress=false"]
    if folder is not None:
        yield compose_config(words), Path(folder)
        return
    with tempfile.TemporaryDirectory(prefix="nsm-") as temporary:
        yield compose_config([*words, "logger=none"]), Path(temporary)


def load(folder: str | Path) -> NeuralSurface | Parameterization:
    """Give back the result of a run.

    Args:
        folder: the run folder, or its ``surface.safetensors``.

    Returns:
        What the run made: a neural surface, or a map with the surfaces it needs.

    Raises:
        NsmError: nothing there, or a file that is damaged or of another version.
    """
    if (Path(folder) / "map.json").exists():
        return load_parameterization(folder)
    return load_surface(folder)
