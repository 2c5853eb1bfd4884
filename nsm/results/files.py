"""Files that are written whole or not at all, and artefacts as pairs of them.

An artefact is STEM.safetensors (weights and arrays) beside STEM.json (its metadata: settings,
figures, and the checksum of the first). There is no pickle: loading runs no code of theirs.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import pickletools
import re
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from nsm.errors import NotRegistered, NotTrusted, NsmError
from nsm.results.old_versions import from_version_1

if TYPE_CHECKING:
    from PIL.Image import Image

VERSION = 2
PNG_LEVEL = 4  # of zlib: 6, the usual one, takes nearly twice as long for files 2 to 8 % smaller
# what the metadata and tensors of a damaged or forged artefact may raise while it is put together
DAMAGE = (
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

# what the pickle of a checkpoint needs
_CALLED = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|torch (\w+Storage|Size)"
)


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


def write_png(path: str | Path, image: Image) -> None:
    """Write an image of PIL as PNG (see :func:`atomic_write`)."""
    data = io.BytesIO()
    image.save(data, format="PNG", compress_level=PNG_LEVEL)
    atomic_write(path, data.getvalue())


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
    stem: Path, form: str, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]
) -> None:
    """Write an artefact, whole or not at all: the one before stays until its JSON is replaced.

    The old tensors stay beside the new ones, as STEM.previous.safetensors, until then.

    Args:
        stem: path of the two files without their endings.
        form: name of the format.
        tensors: weights and arrays.
        metadata: what goes into the JSON.

    Raises:
        OSError: the folder cannot be written.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    data = save({name: tensor.contiguous() for name, tensor in tensors.items()})
    head = {"format": form, "version": VERSION, "sha256": hashlib.sha256(data).hexdigest()}
    file, previous = stem.with_suffix(".safetensors"), _previous(stem)
    if file.exists() and not _is_committed(stem, previous):
        os.replace(file, previous)
    atomic_write(file, data)
    atomic_write(stem.with_suffix(".json"), as_json({**head, **metadata}))
    previous.unlink(missing_ok=True)


def _previous(stem: Path) -> Path:
    return stem.with_suffix(".previous.safetensors")


def _is_committed(stem: Path, previous: Path) -> bool:
    """Whether a write that was interrupted left the tensors of the JSON in ``previous``."""
    try:
        metadata = json.loads(stem.with_suffix(".json").read_bytes())
        data = previous.read_bytes()
    except (OSError, ValueError):
        return False
    return isinstance(metadata, dict) and metadata.get("sha256") == hashlib.sha256(data).hexdigest()


def as_json(metadata: Any) -> bytes:
    """Standard JSON: numbers that are not finite become null."""
    return (json.dumps(_finite(metadata), indent=2, allow_nan=False) + "\n").encode()


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_pair(stem: Path, form: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and metadata of an artefact; those of version 1 as version 2 has them.

    Args:
        stem: path of the two files without their endings.
        form: name of the format.

    Raises:
        NsmError: ``missing_file``, ``unreadable_file``, ``not_a_file``, ``wrong_format``,
            ``wrong_version``, ``damaged_file``.
    """
    file, tensor_file = stem.with_suffix(".json"), stem.with_suffix(".safetensors")
    try:
        metadata = json.loads(_read(file))
    except (ValueError, RecursionError) as error:
        message = f"{file}: not readable as JSON; make the run again"
        raise NsmError(message, kind="damaged_file", key=str(file)) from error
    if not isinstance(metadata, dict) or metadata.get("format") != form:
        message = f"{file}: not of format {form}; give the folder of a run that made one"
        raise NsmError(message, kind="wrong_format", key=str(file))
    version = metadata.get("version")
    if version not in (1, VERSION):
        message = (
            f"{file}: version {version}, but this nsm reads version 1 to {VERSION}; update nsm"
        )
        raise NsmError(message, kind="wrong_version", key=str(file))
    # an interrupted write has left the tensors of this JSON under the other name
    data = _read(_previous(stem) if _is_committed(stem, _previous(stem)) else tensor_file)
    if hashlib.sha256(data).hexdigest() != metadata.get("sha256"):
        raise NsmError(
            f"{tensor_file}: truncated or changed (its checksum is not the one in {file.name}); "
            "copy the folder or make the run again",
            kind="damaged_file",
            key=str(tensor_file),
        )
    try:
        tensors = load(data)
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not tensor.isfinite().all():
                raise ValueError(f"{name} is not finite")
        return from_version_1(tensors, metadata) if version == 1 else (tensors, metadata)
    except (SafetensorError, *DAMAGE) as error:
        raise damaged(stem, error) from error


def check_stored(checkpoint: Path) -> None:
    """Refuse a checkpoint that may take more memory than its size.

    ``torch.load(weights_only=True)`` runs no code, but it inflates compressed members, and makes
    room by a number (``bytearray(10**10)``).

    Raises:
        ValueError: a compressed member, or a call that no checkpoint of ours needs.
    """
    with zipfile.ZipFile(checkpoint) as members:
        for member in members.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError("compressed members")
            if not member.filename.endswith(".pkl"):
                continue
            for code, argument, _ in pickletools.genops(members.read(member)):
                # torch knows no other opcode that names something
                if code.name == "GLOBAL" and not _CALLED.fullmatch(str(argument)):
                    raise ValueError(f"{argument} is nothing that a checkpoint needs")


def damaged(stem: Path, error: Exception) -> NsmError:
    """The error for an artefact whose parts do not fit together, or whose code is not known."""
    if isinstance(error, (NotRegistered, NotTrusted)):
        return NsmError(f"{stem}: {error}", kind=error.kind, key=error.key)
    reason = " ".join(str(error).split())[:120]
    message = f"{stem}: its two files do not fit together ({reason}); make the run again"
    return NsmError(message, kind="damaged_file", key=str(stem))


def _read(file: Path) -> bytes:
    if file.exists() and not file.is_file():  # a pipe would be waited for, a device read for ever
        message = f"{file}: not a regular file; give the folder of a complete run"
        raise NsmError(message, kind="not_a_file", key=str(file))
    try:
        return file.read_bytes()
    except OSError as error:
        kind = "unreadable_file" if file.exists() else "missing_file"
        reason = error.strerror or "cannot be read"
        message = f"{file}: {reason}; give the folder of a complete run"
        raise NsmError(message, kind=kind, key=str(file)) from error
