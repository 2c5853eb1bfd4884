"""``nsm landmarks``: place corresponding landmarks on meshes in the browser."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console

from nsm.arguments import Arguments
from nsm.commands import add_address
from nsm.errors import NsmError
from nsm.loading_libraries import loading_libraries
from nsm.optional_dependencies import needed
from nsm.stages import stage

if TYPE_CHECKING:
    from nsm.correspondence.landmark_list import LandmarkList
    from nsm.results.view import EditedShape
    from nsm.surfaces.validation import Repairs


def main(arguments: list[str]) -> None:
    """Serve the editor until Ctrl-C.

    Raises:
        NsmError: wrong arguments, a mesh or file that cannot be read, ``file_exists``, or as
            :func:`nsm.results.view.running`.
        KeyboardInterrupt: Ctrl-C.
    """
    parser = Arguments(
        prog="nsm landmarks",
        description="Place corresponding landmarks on two meshes or more in the browser, side by "
        "side. Those that landmarks=auto would propose are there to begin with, where all meshes "
        "are closed and of genus 0.",
        epilog="Every task reads the file: nsm task=pair_map source=a.obj target=b.obj "
        "landmarks=pairs.json.",
    )
    parser.add_argument("mesh", nargs="+", metavar="MESH", help="a mesh file or a catalogue name")
    parser.add_argument(
        "--landmarks", type=Path, metavar="FILE", help="begin with the landmarks of a JSON file"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("pairs.json"),
        metavar="FILE",
        help="where they are saved; default: %(default)s",
    )
    parser.add_argument(
        "--parts",
        metavar="PART",
        help="of meshes of several parts: largest, or a number, 0 for the largest area, as "
        "surface.parts has it",
    )
    parser.add_argument(
        "--repair", choices=["split"], help="cut meshes apart at non-manifold edges"
    )
    parser.add_argument("--empty", action="store_true", help="begin without landmarks")
    parser.add_argument(
        "--check", action="store_true", help="begin with the coarse map of the landmarks"
    )
    add_address(parser)
    given = parser.parse_args(arguments)
    if len(given.mesh) < 2:
        raise NsmError("nsm landmarks: give two meshes or more", kind="bad_argument")
    if given.out.exists() and given.out != given.landmarks:
        raise NsmError(
            f"{given.out}: exists; begin with it by --landmarks {given.out}, or give another --out",
            kind="file_exists",
            key=str(given.out),
        )
    part = _part(given.parts)
    needed("viser", "nsm landmarks", "view")
    # torch takes seconds to import, which --help and wrong options do not need
    with loading_libraries(frozen=True):
        from nsm.results.view import LandmarkEditor, running
        from nsm.surfaces.validation import Repairs

    shapes = [_shape(name, Repairs(part, given.repair)) for name in given.mesh]
    landmarks = _start(shapes, given.landmarks, given.empty)
    with running("nsm landmarks", given.host, given.port) as (server, address):
        editor = LandmarkEditor(shapes, landmarks, given.out, server)
        if given.check:
            editor.check()
        print(f"{given.out}: {address} (Ctrl-C ends)", flush=True)
        while True:
            time.sleep(3600)


def _part(given: str | None) -> Literal["largest"] | int | None:
    """Which part of a mesh is kept."""
    if given is None:
        return None
    if given == "largest":
        return "largest"
    if not given.isdecimal():
        raise NsmError(
            f"--parts {given}: give largest, or a number from 0",
            kind="bad_argument",
            key="--parts",
        )
    return int(given)


def _shape(name: str, repairs: Repairs) -> EditedShape:
    from nsm.domains import domain
    from nsm.domains.joint_preparation import Mesh
    from nsm.pipeline.resolve_inputs import read_shape
    from nsm.results.view import EditedShape
    from nsm.surfaces.validation import clean

    mesh = read_shape(name, domain("disc"), "mesh")
    if not isinstance(mesh, Mesh):
        raise NsmError(f"{name}: no mesh; give a mesh file", kind="wrong_type", key=name)
    cleaned = clean(mesh.vertices, mesh.faces, mesh.name, repairs)
    return EditedShape(mesh.name, cleaned.vertices, cleaned.faces, cleaned.source_vertex)


def _start(shapes: Sequence[EditedShape], file: Path | None, empty: bool) -> LandmarkList:
    """The landmarks of a file, or those proposed; none where nothing can be proposed."""
    from nsm.correspondence.landmark_list import LandmarkList
    from nsm.surfaces.landmark_files import read_collection, read_names, read_pairs
    from nsm.surfaces.landmarks import as_vertices, check_equal_lengths, numbered

    count = len(shapes)
    if file is not None:
        lists = list(read_pairs(file)) if count == 2 else read_collection(file)
        if len(lists) != count:
            raise NsmError(
                f"{file}: landmarks of {len(lists)} surfaces; {count} are edited",
                kind="out_of_range",
                key=str(file),
            )
        check_equal_lengths([shape.name for shape in shapes], lists)
        ids = [
            as_vertices(numbered(of_one, s.numbers, s.name), s.vertices, s.faces, s.name).vertex
            for s, of_one in zip(shapes, lists, strict=True)
        ]
        names = read_names(file)
        if names is not None and len(names) != len(ids[0]):
            raise NsmError(
                f"{file}: {len(names)} names for {len(ids[0])} landmarks",
                kind="different_lengths",
                key=str(file),
            )
        return LandmarkList(count, ids, names)
    if empty:
        return LandmarkList(count)
    from nsm.correspondence import proposed_for_all

    console = Console(highlight=False)
    try:
        with stage(console, f"proposing landmarks of {', '.join(shape.name for shape in shapes)}"):
            found = proposed_for_all([(s.vertices, s.faces) for s in shapes])
    except NsmError as error:
        console.print(f"begins without landmarks: {error}", soft_wrap=True, markup=False)
        return LandmarkList(count)
    sure = "sure" if found.sure else "NOT SURE, check each"
    console.print(f"{len(found.vertices[0])} landmarks proposed, {sure}")
    return LandmarkList(count, list(found.vertices[0].T))
