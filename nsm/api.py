"""The public Python API: the tasks of the command line as functions."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from nsm.command_line import prepared_overrides
from nsm.config import compose_config, conf_folder, dotted, unknown_setting
from nsm.domains import Surface
from nsm.errors import NsmError, of_disk
from nsm.help import known_keys
from nsm.instantiation import target_of
from nsm.migration import check_override
from nsm.pipeline import Given, run_task
from nsm.pipeline.folder_lock import folder_lock
from nsm.results import (
    NeuralSurface,
    Parameterization,
    SurfaceCollection,
    SurfaceMap,
)
from nsm.results.parameterization_atlas import ParameterizationAtlas
from nsm.run_directories import temporary_folder
from nsm.surfaces.given import no_mesh


def overfit(
    surface: Any,
    *,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> NeuralSurface:
    """Train a network to reproduce a surface.

    Args:
        surface: a prepared surface; or a mesh: a file, a name of the catalogue, an object of
            trimesh, or a pair of arrays (V, 3), (F, 3).
        overrides: settings as on the command line, e.g. ``["trainer.max_steps=1000"]``.
        folder: where to leave the run's files; without it they are not kept.
        progress: show what goes on, and the figures at the end; without it nothing is printed.
        **settings: settings by name: a string chooses the option of a group, a dictionary sets
            the settings within, a class is what ``_target_`` names:
            ``activation="silu", trainer={"max_steps": 1000}, seed=1``.

    Returns:
        The neural surface φ with its figures in ``metrics``.

    Raises:
        NsmError: a setting that does not exist or cannot be used.

    Examples:
        >>> phi = nsm.overfit(nsm.Surface.load("terrain"), experiment="quick")
        >>> phi(uv)  # (N, 2) points of Ω to (N, 3)
    """
    _needed("surface", surface)
    ready = [surface] if isinstance(surface, Surface) else []
    request = _Request("overfit", overrides, settings, ready)
    with request.run(folder, progress) as (config, place):
        return run_task(config, place, given=Given(surface=surface), quiet=not progress)


def parameterize(
    phi: Any,
    *,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> Parameterization | ParameterizationAtlas:
    """Flatten a neural surface to the plane with least distortion and a free boundary.

    Args:
        phi: a neural surface; or a surface or mesh as for :func:`overfit`, of which one is made.
        overrides, folder, progress, **settings: as for :func:`overfit`, e.g.
            ``energy="conformal"``.

    Returns:
        The map with its new coordinates in ``uv``, and its figures beside those of libigl's
        methods in ``metrics``; or, where ``seams`` cut the mesh into several charts, an atlas of
        such maps.

    Raises:
        NsmError: a setting that does not exist or cannot be used.

    Examples:
        >>> flat = nsm.parameterize(phi)
        >>> flat.uv  # (V, 2), of the cut mesh's vertices
    """
    _needed("phi", phi)
    given = phi.surface if isinstance(phi, NeuralSurface) else phi
    request = _Request("param", overrides, settings, [given] if isinstance(given, Surface) else [])
    with request.run(folder, progress) as (config, place):
        return run_task(config, place, given=Given(phi=phi), quiet=not progress)


def map_pair(
    source: Any,
    target: Any,
    landmarks: Any = None,
    *,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> SurfaceMap:
    """Map one surface to another with least distortion.

    Two closed meshes, given as files, are cut along corresponding paths through their landmarks,
    which gives the best maps; neural surfaces are taken as they are. An open source of genus 0 is
    mapped into a closed target, onto the part of it that corresponds; give four landmarks or more.

    Args:
        source: a neural surface, the folder of one, a mesh file, a name of the catalogue, an
            object of trimesh, a pair of arrays (V, 3), (F, 3), or a Surface, whose mesh is prepared
            again for the map.
        target: the same; or an analytic surface, by name or as ``{"name": ..., parameters}``.
        landmarks: pairs ``[(i, j), ...]`` of vertices of the two meshes as given, counted from
            0 (of an OBJ file its ``v`` lines), or of points (x, y, z), in lists, an array or a
            tensor; or a JSON file of them; or two files, one for each surface.
        overrides, folder, progress, **settings: as for :func:`overfit`, e.g. ``energy="arap"``.

    Returns:
        The map: ``f(points)``, ``f.transfer(values)``, ``f.metrics``.

    Raises:
        NsmError: a surface, landmark or setting that cannot be used.

    Examples:
        >>> f = nsm.map_pair("cat.obj", "horse.obj", landmarks=[(5259, 2289), (3651, 5255)])
        >>> f(points)  # (N, 3) on the cat to (N, 3) on the horse
    """
    ready = _prepared((source, target))
    request = _Request("pair_map", overrides, settings, ready)
    with request.run(folder, progress) as (config, place):
        given = Given(source=source, target=target, landmarks=landmarks)
        return run_task(config, place, given=given, quiet=not progress)


def map_collection(
    surfaces: Any,
    landmarks: Any = None,
    *,
    template: Any = None,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> SurfaceCollection:
    """Put three surfaces or more into correspondence, every one with every other.

    Args:
        surfaces: as for :func:`map_pair`, in a list; or a pattern of files, ``"scans/*.ply"``.
        landmarks: for each surface a list of vertices or points, None for one that it lacks, or a
            file; or one JSON or CSV file; or a folder with a file for each surface. By default
            files beside the meshes that have their names.
        template: a surface that all others are mapped to and from; the first of the collection.
        overrides, folder, progress, **settings: as for :func:`overfit`.

    Returns:
        The collection; ``collection.pair(i, j)`` is the map from one surface to another, by number
        or name.

    Raises:
        NsmError: a surface, landmark or setting that cannot be used.

    Examples:
        >>> animals = nsm.map_collection(["a.off", "b.off", "c.off"], ["a.vts", "b.vts", "c.vts"])
        >>> animals.pair("a", "c").transfer(colours)
    """
    if not isinstance(surfaces, (Sequence, Path)):
        raise NsmError("surfaces: give a list of them", kind="wrong_type", key="surfaces")
    listed = [surfaces] if isinstance(surfaces, (str, Path)) else surfaces
    ready = _prepared([*listed, template])
    request = _Request("collection_map", overrides, settings, ready)
    with request.run(folder, progress) as (config, place):
        given = Given(surfaces=listed, landmarks=landmarks, template=template)
        return run_task(config, place, given=given, quiet=not progress)


def _prepared(given: Sequence[Any]) -> list[Surface]:
    """The prepared surfaces among those given."""
    surfaces = [one.surface if isinstance(one, NeuralSurface) else one for one in given]
    return [surface for surface in surfaces if isinstance(surface, Surface)]


# what the function that is called, and its arguments, say
_ARGUMENTS = (
    *("task", "surface", "phi.path", "source", "target", "surfaces", "template", "landmarks"),
)


class _Request:
    """The settings of a call.

    Args:
        task: of the function.
        overrides, settings: as the user gives them.
        ready: the prepared surfaces among the arguments: their domain is taken.

    Raises:
        NsmError: no settings, unknown ones, or some that conflict with each other or with the
            arguments.
    """

    def __init__(
        self,
        task: str,
        overrides: Sequence[str],
        settings: Mapping[str, Any],
        ready: Sequence[Surface],
    ) -> None:
        if isinstance(overrides, str) or not all(isinstance(word, str) for word in overrides):
            raise NsmError(
                'overrides: give a list of settings, as in ["trainer.max_steps=1000"]',
                kind="wrong_type",
                key="overrides",
            )
        settings = dict(settings)
        if "device" in settings:
            overrides = [*overrides, f"device={settings.pop('device')}"]
        overrides = prepared_overrides(overrides)
        known = {key.partition(".")[0] for key in known_keys()}
        chosen, merged = [], {}
        for setting in dotted(settings):
            name, _, text = setting.partition("=")
            check_override(name, text)
        for key, value in settings.items():
            if key in known_keys() and "." in key:
                group, _, rest = key.partition(".")
                raise NsmError(
                    f"{key}: no argument has a dot; give {group}={{{rest!r}: ...}}, or "
                    f'overrides=["{key}=..."]',
                    kind="unknown_setting",
                    key=key,
                )
            if key not in known:
                raise unknown_setting(key)
            if value is None or isinstance(value, str) and (conf_folder() / key).is_dir():
                chosen.append(f"{key}={'null' if value is None else value}")
            else:
                merged[key] = _plain(key, value)
        keys = [word.lstrip("+~").partition("=")[0] for word in overrides]
        for key in (*keys, *settings):
            if key != "task" or not isinstance(merged.get(key), dict):  # a variant of the task
                self._check(key, ready)
        for key in settings:
            twice = [k for k in keys if k == key or k.startswith(f"{key}.")]
            if twice:
                raise NsmError(
                    f"{twice[0]}: given in overrides and as an argument; omit one",
                    kind="conflicting_settings",
                    key=twice[0],
                )
        if ready:
            domain = str(ready[0].domain)
            if (conf_folder() / "domain" / f"{domain}.yaml").is_file():
                chosen.append(f"domain={domain}")
            else:
                merged["domain"] = ready[0].domain.config
        self.overrides, self.settings = [f"task={task}", *overrides, *chosen], merged

    def _check(self, key: str, ready: Sequence[Surface]) -> None:
        """NsmError for a setting that would do nothing beside the arguments."""
        said = (*_ARGUMENTS, *(["domain"] if ready else []))
        if key == "resume":
            raise NsmError(
                "resume: the command continues runs, nsm resume=FOLDER",
                kind="conflicting_settings",
                key=key,
            )
        if any(key == one or key in (f"{one}.path", f"{one}.name") for one in said):
            raise NsmError(
                f"{key}: the function and its arguments set it; omit it",
                kind="conflicting_settings",
                key=key,
            )

    @contextmanager
    def run(self, folder: str | Path | None, progress: bool) -> Iterator[tuple[DictConfig, Path]]:
        """The configuration, and the run folder: a temporary one, without logs, if none is given.

        Raises:
            NsmError: settings that cannot be used, or a folder that cannot be written.
        """
        overrides = list(self.overrides)
        if not progress:
            overrides.append("trainer.progress=false")
        try:
            if folder is not None:
                config = compose_config(overrides, self.settings)
                with folder_lock(Path(folder)):
                    yield config, Path(folder)
                return
            if "logger" not in self.settings and not any("logger" in o for o in overrides):
                overrides.append("logger=none")
            with temporary_folder() as temporary:
                config = compose_config([*overrides, "artefacts=false"], self.settings)
                yield config, Path(temporary)
        except OSError as error:
            raise NsmError(
                f"{of_disk(error)}; give another folder, or make room", kind="unwritable_folder"
            ) from error


def _needed(name: str, given: Any) -> None:
    """Refuse None, in whose place the settings' own surface would be taken."""
    if given is None:
        raise no_mesh("None", name)


def _plain(key: str, value: Any) -> Any:
    """A setting with ``_target_`` for the classes and functions in it; NsmError for objects."""
    if inspect.isclass(value) or inspect.isfunction(value):
        return {"_target_": _name(value)}
    if isinstance(value, Mapping):
        return {
            k: _name(v) if k == "_target_" else _plain(f"{key}.{k}", v) for k, v in value.items()
        }
    if isinstance(value, (list, tuple)):
        return [_plain(key, item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    kind = type(value).__name__
    raise NsmError(
        f"{key}: an object of {kind} cannot be written down; give its class, or "
        f'{{"_target_": {kind}, ...}} with its parameters',
        kind="wrong_type",
        key=key,
    )


def _name(target: Any) -> Any:
    """The ``_target_`` of a class or function; a name as it is."""
    return target_of(target) if callable(target) else target
