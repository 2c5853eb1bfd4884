"""The public Python API: the words of the command line, as functions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nsm.config import compose_config
from nsm.domains import Surface
from nsm.errors import NsmError, of_disk
from nsm.pipeline import run_collection_map, run_overfit, run_pair_map, run_param
from nsm.pipeline.folder_lock import folder_lock
from nsm.results import (
    NeuralSurface,
    Parameterization,
    SurfaceCollection,
    SurfaceMap,
    load_collection,
    load_parameterization,
    load_surface,
    load_surface_map,
)
from nsm.run_directories import passing_folder
from nsm.sweeps import is_complete


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
    _expect(surface, Surface)
    words = _words("overfit", overrides, [surface], ("landmarks",))
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
    _expect(phi, NeuralSurface)
    words = _words("param", overrides, [phi.surface], ("landmarks",))
    with _place(folder, words, progress) as (config, place):
        return run_param(config, place, phi)


def map_pair(
    source: NeuralSurface | str | Path,
    target: NeuralSurface | str | Path | dict[str, Any],
    landmarks: Any = None,
    *,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
) -> SurfaceMap:
    """Map one surface to another with least distortion.

    Two closed meshes, given as files, are cut alike through their landmarks, which is what makes
    a good map; neural surfaces are taken as they are.

    Args:
        source: a neural surface, the folder of one, a mesh file, or a name of the catalogue.
        target: the same; or an analytic surface, by name or as ``{"name": ..., parameters}``.
        landmarks: pairs ``[(i, j), ...]`` of vertices of the two mesh files, or of points (x, y,
            z), in lists, an array or a tensor; or a JSON file of them; or two files, one for each
            surface.
        overrides: settings as on the command line, e.g. ``["energy=arap"]``.
        folder: where to leave the run's files; without it they are not kept.
        progress: show a progress bar.

    Returns:
        The map: ``f(points)``, ``f.transfer(values)``, ``f.metrics``.

    Raises:
        NsmError: a surface, landmark or setting that cannot be used.

    Examples:
        >>> f = nsm.map_pair("cat.obj", "horse.obj", landmarks=[(5259, 2289), (3651, 5255)])
        >>> f(points)  # (N, 3) on the cat to (N, 3) on the horse
    """
    ready = [end.surface for end in (source, target) if isinstance(end, NeuralSurface)]
    words = _words("pair_map", overrides, ready, () if landmarks is None else ("landmarks",))
    with _place(folder, words, progress) as (config, place):
        return run_pair_map(config, place, source, target, landmarks)


def map_collection(
    surfaces: Sequence[NeuralSurface | str | Path],
    landmarks: Any = None,
    *,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
) -> SurfaceCollection:
    """Put three surfaces or more into correspondence, every one with every other.

    Args:
        surfaces: as for :func:`map_pair`.
        landmarks: for each surface a list of vertices or points, or a file; or one JSON file.
        overrides, folder, progress: as for :func:`map_pair`.

    Returns:
        The collection; ``collection.pair(i, j)`` is the map from one surface to another.

    Raises:
        NsmError: a surface, landmark or setting that cannot be used.

    Examples:
        >>> animals = nsm.map_collection(["a.off", "b.off", "c.off"], ["a.vts", "b.vts", "c.vts"])
        >>> animals.pair(0, 2).transfer(colours)
    """
    if not isinstance(surfaces, Sequence):
        raise NsmError("surfaces: give a list of them")
    ready = [phi.surface for phi in surfaces if isinstance(phi, NeuralSurface)]
    words = _words("collection_map", overrides, ready, () if landmarks is None else ("landmarks",))
    with _place(folder, words, progress) as (config, place):
        return run_collection_map(config, place, surfaces, landmarks)


# what the function that is called, and its arguments, say
_SAID = (
    "task",
    "surface",
    "surface.path",
    "surface.name",
    "phi.path",
    "source",
    "target",
    "surfaces",
)


def _words(
    task: str, overrides: Sequence[str], ready: Sequence[Surface], said: Sequence[str]
) -> list[str]:
    """The settings of a call.

    Args:
        task: of the function.
        overrides: as the user gives them.
        ready: the prepared surfaces that it is called with: their domain is taken.
        said: settings, beside :data:`_SAID`, that its arguments say.

    Raises:
        NsmError: no list of settings, or one that would do nothing beside the arguments.
    """
    if isinstance(overrides, str) or not all(isinstance(word, str) for word in overrides):
        raise NsmError('overrides: give a list of settings, as in ["trainer.max_steps=1000"]')
    own = [f"task={task}", *(f"domain={surface.domain}" for surface in ready[:1])]
    for word in overrides:
        key = word.lstrip("+~").split("=")[0]
        if key == "resume":
            raise NsmError(f"overrides: {word}: a run goes on with the command, nsm {word}")
        taken = key in (*_SAID, *said) or (key == "domain" and ready)
        if taken and word not in own:
            raise NsmError(
                f"overrides: {word}: the function and its arguments say that; leave it out"
            )
    return [own[0], *overrides, *own[1:]]


def _expect(given: Any, kind: type) -> None:
    if not isinstance(given, kind):
        raise NsmError(f"give a {kind.__name__}, not a {type(given).__name__}")


@contextmanager
def _place(
    folder: str | Path | None, words: list[str], progress: bool
) -> Iterator[tuple[DictConfig, Path]]:
    """The configuration, and the run folder: a passing one, without logs, if none is given."""
    if not progress:
        words = [*words, "trainer.progress=false"]
    try:
        if folder is not None:
            config = compose_config(words)
            with folder_lock(Path(folder)):
                yield config, Path(folder)
            return
        with passing_folder() as temporary:
            yield compose_config([*words, "logger=none", "artefacts=false"]), Path(temporary)
    except OSError as error:
        raise NsmError(f"{of_disk(error)}; give another folder, or make room") from error


def load(
    folder: str | Path,
) -> NeuralSurface | Parameterization | SurfaceMap | SurfaceCollection:
    """Give back the result of a run.

    Args:
        folder: the run folder, or its ``surface.safetensors``.

    Returns:
        What the run made: a neural surface, or a map with the surfaces it needs.

    Raises:
        NsmError: nothing there, or a file that is damaged or of another version.
    """
    place = Path(folder)
    if not place.exists():
        raise NsmError(f"{folder}: no such folder; give the folder of a run")
    if (place / "collection.json").exists():
        return load_collection(folder)
    if (place / "pair.json").exists():
        return load_surface_map(folder)
    if (place / "map.json").exists():
        return load_parameterization(folder)
    if place.is_dir() and not list(place.glob("surface.*")):
        raise NsmError(f"{folder}: {_no_result(place)}")
    return load_surface(folder)


def _no_result(folder: Path) -> str:
    """What a folder without a result is, and what to give instead."""
    # the report's libraries need not be there before something is wrong
    from nsm.results.report.runs import run_folders

    within = [place for place in run_folders(folder) if is_complete(place)]
    if folder in within:
        return "a run's figures, but not its result; copy the folder or make the run again"
    if within:
        give = "one of them, for example" if len(within) > 1 else "it:"
        newest = max(within, key=lambda place: (place / "metrics.json").stat().st_mtime)
        runs = f"{len(within)} run{'s' if len(within) > 1 else ''}"
        return f"a folder of {runs}; give {give} {newest}"
    if (folder / "config.yaml").exists():
        return f"a run that has not ended; nsm resume={folder} goes on with it"
    return "no run there; give the folder of a run"
