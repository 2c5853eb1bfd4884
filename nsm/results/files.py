"""Files that are whole or not there at all, and artefacts as pairs of them.

An artefact is STEM.safetensors (weights and arrays) beside STEM.json (everything else, and the
checksum of the first). Loading executes nothing from them: there is no pickle.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import pickletools
import re
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from nsm.errors import NotRegistered, NsmError

# What the words and arrays of a damaged or forged artefact may raise while it is put together.
BROKEN = (
    KeyError,
    TypeError,
    ValueError,
    RuntimeError,
    AttributeError,
    ArithmeticError,
    IndexError,
    MemoryError,
    NsmError,
)


# what the pickle of a checkpoint may call, and all of pickle's ways to name something
_CALLED = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|torch (\w+Storage|Size)"
)
_NAMING = ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4")


def atomic_write(path: str | Path, data: bytes) -> None:
    """Write beside the target, flush to the disk, then move into its place.

    Raises:
        OSError: the disk is full or the folder cannot be written; the old file is untouched.
    """
    target = Path(path)
    descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=target.name, suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp gives 0600; results are as readable as any file the user writes
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, target)
        flush_folder(target.parent)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def flush_folder(folder: Path) -> None:
    """Bring a renaming to the disk, where the system can."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_pair(
    stem: Path, form: str, version: int, tensors: Mapping[str, Tensor], words: Mapping[str, Any]
) -> None:
    """Write an artefact, whole or not at all: the one before holds until its JSON is replaced.

    The old tensors stay beside the new ones, as STEM.previous.safetensors, until then.

    Raises:
        OSError: the folder cannot be written.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    data = save(dict(tensors))
    head = {"format": form, "version": version, "sha256": hashlib.sha256(data).hexdigest()}
    file, previous = stem.with_suffix(".safetensors"), _previous(stem)
    if file.exists() and not _is_committed(stem, previous):
        os.replace(file, previous)
    atomic_write(file, data)
    atomic_write(stem.with_suffix(".json"), as_json({**head, **words}))
    previous.unlink(missing_ok=True)


def _previous(stem: Path) -> Path:
    return stem.with_suffix(".previous.safetensors")


def _is_committed(stem: Path, previous: Path) -> bool:
    """Whether a writing that was cut short left the tensors that the JSON means in ``previous``."""
    try:
        words = json.loads(stem.with_suffix(".json").read_bytes())
        data = previous.read_bytes()
    except (OSError, ValueError):
        return False
    return isinstance(words, dict) and words.get("sha256") == hashlib.sha256(data).hexdigest()


def as_json(words: Any) -> bytes:
    """JSON text that every reader takes: figures that are not finite become null."""
    return (json.dumps(_finite(words), indent=2, allow_nan=False) + "\n").encode()


def _finite(words: Any) -> Any:
    if isinstance(words, Mapping):
        return {key: _finite(value) for key, value in words.items()}
    if isinstance(words, (list, tuple)):
        return [_finite(value) for value in words]
    return None if isinstance(words, float) and not math.isfinite(words) else words


def read_pair(stem: Path, form: str, version: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and words of an artefact.

    Raises:
        NsmError: a file that is missing, truncated, damaged, of another format or version.
    """
    file = stem.with_suffix(".json")
    try:
        words = json.loads(_read(file))
    except (ValueError, RecursionError) as error:
        raise NsmError(f"{file}: not readable as JSON; make the run again") from error
    if not isinstance(words, dict) or words.get("format") != form:
        raise NsmError(f"{file}: not of format {form}; give the folder of a run that made one")
    if words.get("version") != version:
        raise NsmError(
            f"{file}: version {words.get('version')}, but this nsm reads version {version}; "
            "make the run again with this nsm"
        )
    # a writing that was cut short has left the tensors of this JSON under the other name
    short = _is_committed(stem, _previous(stem))
    data = _read(_previous(stem) if short else stem.with_suffix(".safetensors"))
    if hashlib.sha256(data).hexdigest() != words.get("sha256"):
        raise NsmError(
            f"{stem.with_suffix('.safetensors')}: truncated or changed (its checksum is not the "
            f"one in {file.name}); copy the folder or make the run again"
        )
    try:
        tensors = load(data)
    except (SafetensorError, *BROKEN) as error:
        raise misfit(stem, error) from error
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise misfit(stem, ValueError(f"{name} is not finite"))
    return tensors, words


def check_stored(archive: Path) -> None:
    """ValueError for a checkpoint that may take more memory than its size.

    Its members must be stored as they are, and it must be made of tensors and plain values:
    what is called while it is read makes no room by numbers that are in it.
    """
    with zipfile.ZipFile(archive) as members:
        for member in members.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError("compressed members")
            if not member.filename.endswith(".pkl"):
                continue
            for code, argument, _ in pickletools.genops(members.read(member)):
                named = code.name in _NAMING
                if named and not (code.name == "GLOBAL" and _CALLED.fullmatch(str(argument))):
                    raise ValueError(f"{argument} is nothing that a checkpoint needs")


def misfit(stem: Path, error: Exception) -> NsmError:
    """The message for an artefact whose parts do not fit together."""
    if isinstance(error, NotRegistered):
        return NsmError(f"{stem}: {error}")
    reason = " ".join(str(error).split())[:120]
    return NsmError(f"{stem}: its two files do not fit together ({reason}); make the run again")


def _read(file: Path) -> bytes:
    if file.exists() and not file.is_file():  # a pipe would be waited for, a device read for ever
        raise NsmError(f"{file}: not a regular file; give the folder of a complete run")
    try:
        return file.read_bytes()
    except OSError as error:
        reason = error.strerror or "cannot be read"
        raise NsmError(f"{file}: {reason}; give the folder of a complete run") from error
