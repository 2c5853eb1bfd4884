"""What users write, in the form that Hydra takes: tasks, meshes, paths and devices."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from nsm.errors import NsmError
from nsm.migration import check_override
from nsm.settings import conf_folder
from nsm.wording import number_of

# settings that are files or folders: `~` stands for the home folder in them, and signs that Hydra's
# grammar reserves are quoted for the user
_PATHS = (
    "surface.path",
    "phi.path",
    "source",
    "target",
    "surfaces",
    "template",
    "landmarks",
    "resume",
    "hydra.run.dir",
)
_LISTS = ("surfaces", "landmarks")  # in brackets, of files
_PLAIN = re.compile(r"[\w./+-]+")  # what has one meaning for Hydra
_DEVICES = {"cuda": "gpu", "gpu": "gpu", "cpu": "cpu", "auto": "auto"}


def with_task(words: Sequence[str]) -> list[str]:
    """A command line whose first word names a task, as settings: ``pair_map a.obj b.obj`` is
    ``task=pair_map source=a.obj target=b.obj``.

    Raises:
        NsmError: ``wrong_inputs``: more surfaces than the task takes, or several without a task.
    """
    meshes = [word for word in words if "=" not in word and _is_mesh(word)]
    if len(meshes) > 1 and meshes[0] == words[0]:
        raise NsmError(
            f"{' '.join(meshes)}: several meshes; give a task, nsm pair_map {' '.join(meshes[:2])}",
            kind="wrong_inputs",
            key=meshes[0],
        )
    if not words or "=" in words[0] or not (conf_folder() / "task" / f"{words[0]}.yaml").is_file():
        return list(words)
    task, rest = words[0], [word if "=" in word else os.path.expanduser(word) for word in words[1:]]
    inputs = [word for word in rest if "=" not in word or os.path.isfile(word)]
    settings = [word for word in rest if word not in inputs]
    files = [word for word in inputs if word.lower().endswith(".json")]
    shapes = [word for word in inputs if word not in files]
    if task == "collection_map":
        most, keys = len(shapes), [f"surfaces=[{','.join(map(_quoted, shapes))}]"][: len(shapes)]
    elif task == "pair_map":
        most, keys = 2, [f"{k}={s}" for k, s in zip(("source", "target"), shapes, strict=False)]
    elif task == "param" and shapes and Path(shapes[0]).is_dir():
        most, keys = 1, [f"phi.path={shapes[0]}"]
    else:
        most, keys = 1, [f"surface={shape}" for shape in shapes[:1]]
    if len(shapes) > most or len(files) > ("map" in task):
        raise NsmError(
            f"{task}: {number_of(len(inputs), 'input')}; it takes {number_of(most, 'surface')}"
            f"{' and a file of landmarks' if 'map' in task else ''}",
            kind="wrong_inputs",
            key=task,
        )
    return [f"task={task}", *keys, *(f"landmarks={file}" for file in files), *settings]


def prepared_overrides(overrides: Sequence[str]) -> list[str]:
    """Overrides in the form that Hydra takes.

    ``mesh.obj`` and ``surface=mesh.obj`` become ``surface.path="mesh.obj"``, ``device=cuda``
    becomes ``trainer.accelerator=gpu``; paths may hold ``~``, spaces and special signs.

    Raises:
        NsmError: an override whose setting has another name now, or an unknown device.
    """
    prepared = []
    for override in overrides:
        key, equals, value = override.partition("=")
        if _is_mesh(override) and (not equals or os.path.isfile(override)):
            key, equals, value = "surface.path", "=", override
        elif not equals and override.startswith("~") and not _is_mesh(override):
            prepared.append(override)  # Hydra's sign to delete a setting
            continue
        check_override(key, value)
        if key == "device":
            key, value = "trainer.accelerator", accelerator(value)
        if key == "surface" and (
            all(map(_is_mesh, value.strip("'\"").split(","))) or os.path.isfile(value)
        ):
            key = "surface.path"
        bare = key.lstrip("+")
        if bare in _LISTS and value.startswith("[") and value.endswith("]"):
            value = _readable_list(value)
        elif bare in _PATHS:
            value = _readable_path(value)
        prepared.append(f"{key}={value}" if equals else override)
    return prepared


def accelerator(device: str) -> str:
    """The value of ``trainer.accelerator`` for a device: cuda, gpu, cpu or auto.

    Raises:
        NsmError: ``unknown_option``: another name.
    """
    if device not in _DEVICES:
        raise NsmError(
            f"device={device}: choose one of {', '.join(_DEVICES)}",
            kind="unknown_option",
            key="device",
        )
    return _DEVICES[device]


def _is_mesh(value: str) -> bool:
    from nsm.surfaces.loading import EXTENSIONS

    # of os.path: a name too long for the disk is no file, and no error
    known = os.path.isfile(conf_folder() / "surface" / f"{value}.yaml")
    return not known and ("/" in value or "\\" in value or Path(value).suffix.lower() in EXTENSIONS)


def _readable_path(value: str) -> str:
    path = os.path.expanduser(value)
    # values of a sweep
    parts = path.split(",")
    several = not os.path.exists(path) and all(Path(one).suffix for one in parts[:-1])
    if _PLAIN.fullmatch(path) or (not os.path.exists(path) and _readable(path)):
        return path
    if len(parts) > 1 and several and not path.startswith(("[", "{", "'", '"')):
        return ",".join(_quoted(os.path.expanduser(one)) for one in path.split(","))
    return _quoted(path)


def _readable_list(value: str) -> str:
    """A list with its paths quoted where Hydra could not read them; nested lists as they are."""
    items = value[1:-1].split(",")
    if any("[" in item or "{" in item for item in items):
        return value
    if not any("~" in item for item in items) and _readable(value):
        return value
    return f"[{','.join(_quoted(os.path.expanduser(item.strip())) for item in items)}]"


def _quoted(path: str) -> str:
    written_so = path[:1] in ("'", '"') and _readable(path) and not os.path.exists(path)
    if _PLAIN.fullmatch(path) or written_so:
        return path
    return QuotedString(path, Quote.double).with_quotes()


def _readable(value: str) -> bool:
    try:
        OverridesParser.create().parse_override(f"key={value}")
    except HydraException:
        return False
    return True
