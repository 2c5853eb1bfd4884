"""Load the result of a run from its folder, whatever the task was."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nsm.errors import NsmError
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
from nsm.results.parameterization_atlas import FILE as ATLAS
from nsm.results.parameterization_atlas import ParameterizationAtlas, load_atlas
from nsm.sweeps import is_complete
from nsm.wording import number_of


def load(
    folder: str | Path, *, trust: str | Sequence[str] = ()
) -> NeuralSurface | Parameterization | ParameterizationAtlas | SurfaceMap | SurfaceCollection:
    """Load the result of a run.

    Args:
        folder: the run folder, or its ``surface.safetensors``.
        trust: modules of yours of which the files may name classes, such as ``["mypackage"]``;
            loading runs their code.

    Returns:
        What the run made: a neural surface, or a map with the surfaces it needs.

    Raises:
        NsmError: nothing there, or a file that is damaged, of another version, or that names a
            class outside nsm, torch and the trusted modules.
    """
    place, trust = Path(folder), (trust,) if isinstance(trust, str) else tuple(trust)
    if not place.exists():
        raise NsmError(
            f"{folder}: no such folder; give the folder of a run",
            kind="missing_file",
            key=str(folder),
        )
    if (place / "collection.json").exists():
        return load_collection(folder, trust=trust)
    if (place / "pair.json").exists():
        return load_surface_map(folder, trust=trust)
    if (place / ATLAS).exists():
        return load_atlas(folder, trust=trust)
    if (place / "map.json").exists():
        return load_parameterization(folder, trust=trust)
    if place.is_dir() and not list(place.glob("surface.*")):
        raise NsmError(f"{folder}: {_no_result(place)}", kind="missing_file", key=str(folder))
    return load_surface(folder, trust=trust)


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
        return f"a folder of {number_of(len(within), 'run')}; give {give} {newest}"
    if (folder / "config.yaml").exists():
        return f"an unfinished run; nsm resume={folder} continues it"
    return "no run there; give the folder of a run"
