"""Files of landmarks: of one surface, of a pair, of a collection; and files of ours, written."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from nsm.surfaces.landmarks import Landmarks, listed
from nsm.surfaces.loading import check_file, error_in, is_number
from nsm.wording import number_of

_LARGEST = 10_000_000  # bytes


@dataclass(frozen=True)
class Marks:
    """Landmarks of one surface, and their names if the file has some."""

    landmarks: Landmarks
    names: tuple[str, ...] | None = None


def read_landmarks(path: str | Path) -> Landmarks:
    """The landmarks of one surface, see :func:`read_marks`."""
    return read_marks(path).landmarks


def read_marks(path: str | Path) -> Marks:
    """The landmarks of one surface from a file.

    ``.vts``, ``.txt``, ``.pinned``: a vertex number on each line, after ``lk`` or not, and before a
    name or not; numbers after it are ignored. ``.bary``: triangle, three barycentric coordinates,
    and a name or not, on each line. ``.pp``: picked points of MeshLab. ``.json``: a list of
    vertices, of points [x, y, z], or of places [triangle, b0, b1, b2]; or such a landmark for each
    name. A landmark that the surface lacks is vertex -1, or null in JSON.

    Raises:
        NsmError: ``no_landmarks``, ``damaged_file``, ``wrong_type``, or as
            :func:`nsm.surfaces.loading.check_file`. The key is the path.
    """
    file = Path(path)
    check_file(file, _LARGEST, tuple(_READERS))
    marks = _READERS[file.suffix.lower()](file)
    if len(marks.landmarks) == 0:
        raise error_in(file, "no_landmarks", "no landmarks; give one on each line")
    return marks


def read_pairs(path: str | Path) -> tuple[Landmarks, Landmarks]:
    """The landmarks of source and target from a JSON file.

    The file has {"source": [...], "target": [...]}, or {"pairs": [[i, j], ...]}, or only the list
    of pairs, or two lists as :func:`read_collection` takes them. Landmarks are those of
    :func:`read_marks`; "names" may stand beside them.

    Raises:
        NsmError: as :func:`read_marks`.
    """
    file = Path(path)
    content = _json(file)
    if isinstance(content, dict) and {"source", "target"} <= set(content):
        source, target = (listed(content[end], f"{file}, {end}") for end in ("source", "target"))
        return source, target
    if isinstance(content, dict) and "landmarks" in content:
        lists = read_collection(file)
        if len(lists) != 2:
            what = f"landmarks of {number_of(len(lists), 'surface')}"
            raise error_in(file, "wrong_type", f"{what}; give two")
        return lists[0], lists[1]
    pairs = content.get("pairs") if isinstance(content, dict) else content
    if not isinstance(pairs, list) or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
        reason = 'give {"source": [...], "target": [...]} or a list of pairs'
        raise error_in(file, "wrong_type", reason)
    return listed([p[0] for p in pairs], str(file)), listed([p[1] for p in pairs], str(file))


def read_collection(path: str | Path) -> list[Landmarks]:
    """The landmarks of several surfaces from a JSON file.

    The file has {"landmarks": [[...], ...]}, or only the lists, one per surface; "names" may stand
    beside them.

    Raises:
        NsmError: as :func:`read_marks`.
    """
    file = Path(path)
    content = _json(file)
    lists = content.get("landmarks") if isinstance(content, dict) else content
    if not isinstance(lists, list):
        raise error_in(file, "wrong_type", "give a list of landmarks for each surface")
    return [listed(item, f"{file}, list {k}") for k, item in enumerate(lists)]


def read_names(path: str | Path) -> list[str] | None:
    """The names in a JSON file of a pair or a collection; None if it has none.

    Raises:
        NsmError: as :func:`read_marks`.
    """
    content = _json(Path(path))
    names = content.get("names") if isinstance(content, dict) else None
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise error_in(path, "wrong_type", 'give "names" as a list of words')
    return list(names)


def to_json(
    lists: Sequence[Sequence[Any] | np.ndarray], names: Sequence[str] | None, **more: Any
) -> str:
    """The text of a file that :func:`read_pairs` or :func:`read_collection` reads.

    Args:
        lists: vertices (L,), or places (L, 4), of each surface.
        names: of the landmarks.
        more: what else the file says.
    """
    plain = [np.asarray(item).tolist() for item in lists]
    content: dict[str, Any] = {} if names is None else {"names": list(names)}
    if len(plain) == 2:
        content.update(source=plain[0], target=plain[1])
    else:
        content["landmarks"] = plain
    lines = [
        f"  {json.dumps(key)}: {json.dumps(item)}" for key, item in {**content, **more}.items()
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _vertex_lines(file: Path) -> Marks:
    numbers, names = [], []
    for number, fields in _lines(file):
        if fields[0] == "lk":
            fields = fields[1:]
        try:
            numbers.append(int(fields[0]))
        except (ValueError, IndexError):
            reason = f"line {number} does not start with a vertex number"
            raise error_in(file, "damaged_file", reason) from None
        rest = fields[1:]
        names.append("" if all(map(is_number, rest)) else " ".join(rest))
    return Marks(numbers, _names(names))


def _barycentric_lines(file: Path) -> Marks:
    places, names = [], []
    for number, fields in _lines(file):
        try:
            place = [float(field) for field in fields[:4]]
        except ValueError:
            place = []
        if len(place) < 4 or not np.isfinite(place).all():
            reason = f"line {number} does not start with a triangle and three coordinates"
            raise error_in(file, "damaged_file", reason)
        if not place[0].is_integer():
            reason = f"line {number}: {fields[0]} is no triangle; triangles have whole numbers"
            raise error_in(file, "damaged_file", reason)
        places.append(place)
        names.append(" ".join(fields[4:]))
    return Marks(np.array(places).reshape(-1, 4), _names(names))


def _picked_points(file: Path) -> Marks:
    """MeshLab's format: XML, one element ``point`` for each, those not active left out."""
    points, names = [], []
    parser = expat.ParserCreate()

    def fault(reason: str) -> Exception:
        return error_in(file, "damaged_file", f"line {parser.CurrentLineNumber}: {reason}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag != "point" or attributes.get("active", "1") == "0":
            return
        try:
            point = [float(attributes[axis]) for axis in "xyz"]
        except (KeyError, ValueError):
            point = [np.nan]
        if not np.isfinite(point).all():
            raise fault("a point needs numbers x, y and z")
        points.append(point)
        names.append(attributes.get("name", "").strip())

    def entity(*_: Any) -> None:  # one that names another many times takes all memory
        raise fault("entities are not read; leave them out")

    parser.StartElementHandler = start
    parser.EntityDeclHandler = entity
    try:
        parser.Parse(text(file), True)
    except expat.ExpatError as error:
        raise fault(f"not readable as XML ({expat.ErrorString(error.code)})") from error
    return Marks(np.array(points).reshape(-1, 3), _names(names))


def _json_marks(file: Path) -> Marks:
    content = _json(file)
    if not isinstance(content, dict):
        return Marks(listed(content, str(file)))
    return Marks(listed(list(content.values()), str(file)), _names(list(content)))


_READERS: dict[str, Callable[[Path], Marks]] = {
    ".vts": _vertex_lines,
    ".txt": _vertex_lines,
    ".pinned": _vertex_lines,
    ".bary": _barycentric_lines,
    ".pp": _picked_points,
    ".json": _json_marks,
}
ENDINGS = tuple(_READERS)


def _lines(file: Path) -> list[tuple[int, list[str]]]:
    """Numbers of the lines that say something, and their fields; # starts a comment."""
    lines = enumerate(text(file).splitlines(), start=1)
    split = [(number, line.partition("#")[0].split()) for number, line in lines]
    return [(number, fields) for number, fields in split if fields]


def _names(names: list[str]) -> tuple[str, ...] | None:
    """Names, if each landmark has its own."""
    return tuple(names) if all(names) and len(set(names)) == len(names) else None


def _json(file: Path) -> Any:
    try:
        return json.loads(text(file))
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:80]
        raise error_in(file, "damaged_file", f"not readable as JSON ({reason})") from error


def text(file: Path) -> str:
    """The text of a file of landmarks.

    Raises:
        NsmError: ``damaged_file``, ``unreadable_file``, or as
            :func:`nsm.surfaces.loading.check_file`.
    """
    check_file(file, _LARGEST)
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise error_in(file, "damaged_file", "not a text file") from error
    except OSError as error:
        raise error_in(file, "unreadable_file", error.strerror or "cannot be read") from error
