"""The cases: command lines, the files that they need, and the expected outcomes."""

from __future__ import annotations

import os
import resource
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from torture import files, shapes
from torture.shapes import REFUSED, SOLVED, Mesh

# long enough to approach the mesh, short enough for many cases
OVERFIT = (
    "experiment=quick",
    "trainer.max_steps=200",
    "trainer.progress=false",
    "data.held_out=1024",
    "logger=none",
)
MAP = (
    "trainer.max_steps=20",
    "data.batch_size=512",
    "data.held_out=512",
    "trainer.progress=false",
    "logger=none",
)
PHI = "phi.overrides=['experiment=quick','trainer.max_steps=200']"
BARE = ("artefacts=false",)  # for most cases: pictures take most of the time
PICTURED = ("genus 2", "needles 1e-9", "one triangle", "spike 1e7", "scale 1e-25", "slit")
# nearly a line, or folded everywhere: these need more steps and a finer grid than the others
LONGER = ("triangles 1e6 : 1", "triangles 1e9 : 1", "spike 1e7", "strip of 2000", "crumpled torus")
LONG = ("trainer.max_steps=1000", "encoding.resolutions=[32,128,512]")
SQUARE_TOO = ("genus 3", "10 boundary loops", "needles 1e-6", "open fan of 200", "spike 10")


@dataclass(frozen=True)
class Case:
    """One command.

    Attributes:
        group, name: of the case.
        prepare: writes the files that it needs into a folder, and returns the command's words.
        expected: SOLVED or REFUSED.
        reason: a part of the message of a refusal.
        task: of the command.
        mesh: the mesh of the surface, if the result is to be compared with it.
        limit: largest size in bytes of a file that it may write.
        environment: additional variables.
        around: a context manager that prepares the folder (a full disk).
    """

    group: str
    name: str
    prepare: Callable[[Path], list[str]]
    expected: str
    reason: str = ""
    task: str = "overfit"
    mesh: Callable[[], Mesh] | None = None
    limit: int | None = None
    environment: dict[str, str] = field(default_factory=dict)
    around: Callable[[Path], object] | None = None


def quoted(value: str) -> str:
    """A text quoted as the value of a setting on the command line."""
    for old, new in (("\\", "\\\\"), ('"', '\\"'), ("${", "\\${")):
        value = value.replace(old, new)
    return f'"{value}"'


def _of_shape(make: Callable[[], Mesh], extra: tuple[str, ...], folder: Path) -> list[str]:
    files.write(make(), folder / "mesh.obj")
    return ["surface.path=mesh.obj", *OVERFIT, *extra]


def _of_file(make: Callable[[Path], str], folder: Path) -> list[str]:
    return [f"surface.path={quoted(make(folder))}", *OVERFIT, *BARE]


def _pair(words: list[str], make: Callable[[], Mesh], folder: Path) -> list[str]:
    files.write(make(), folder / "mesh.obj")
    return ["task=pair_map", *words, *MAP, PHI]


def _param(make: Callable[[], Mesh], folder: Path) -> list[str]:
    files.write(make(), folder / "mesh.obj")
    return [
        "task=param",
        "surface.path=mesh.obj",
        *MAP,
        "constraints.boundary=fixed",
        PHI,
    ]


# ------------------------------------------------------------------ disks


@contextmanager
def _small_disk(size: str, folder: Path) -> Iterator[None]:
    """Mount a small disk at ``disk``."""
    (folder / "disk").mkdir()
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", "disk"], cwd=folder, check=True
    )
    try:
        yield
    finally:
        subprocess.run(["umount", "disk"], cwd=folder, check=True)


@contextmanager
def _read_only_disk(folder: Path) -> Iterator[None]:
    with _small_disk("1m", folder):
        subprocess.run(["mount", "-o", "remount,ro", "disk"], cwd=folder, check=True)
        yield


def may_mount() -> bool:
    """Whether this process may mount a disk."""
    if os.geteuid() != 0:
        return False
    done = subprocess.run(
        ["unshare", "--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True
    )
    return done.returncode == 0


def _to_disk(words: list[str], folder: Path) -> list[str]:
    files.write(shapes.bumpy(), folder / "mesh.obj")
    return [f"surface.path={folder}/mesh.obj", *OVERFIT, *BARE, *words]


def _outputs_in_the_way(folder: Path) -> list[str]:
    (folder / "outputs").write_text("a file of this name")
    return _to_disk([], folder)


# ------------------------------------------------------------------ all


def all_cases() -> list[Case]:
    """Every case, in the order of the table."""
    result = []
    for name, shape in shapes.SHAPES.items():
        more = (*(LONG if name in LONGER else ()), *(() if name in PICTURED else BARE))
        for extra in ((), ("domain=square",)) if name in SQUARE_TOO else ((),):
            result.append(
                Case(
                    shape.group,
                    " ".join([name, *extra]),
                    partial(_of_shape, shape.make, (*extra, *more)),
                    shape.expected,
                    shape.reason,
                    mesh=shape.make,
                )
            )
    result += [
        Case("few faces", f"{name} domain=square", partial(_of_shape, make, ("domain=square",)),
             REFUSED, "four boundary vertices")
        for name, make in (("one triangle", shapes.one_triangle),)
    ]  # fmt: skip
    chosen = ("triangles 1e3 : 1", "genus 2", "20 boundary loops", "scale 1e-8", "one triangle",
              "closed fan of 3", "tetrahedron", "spike 1e3", "1e8 from the origin")  # fmt: skip
    for name in chosen:
        make = shapes.SHAPES[name].make
        result.append(Case("flattened", name, partial(_param, make), SOLVED, task="param"))
    for name in chosen:
        make = shapes.SHAPES[name].make
        words = ["source=mesh.obj", "target=paraboloid"]
        result.append(
            Case(
                "mapped",
                f"{name} → paraboloid",
                partial(_pair, words, make),
                SOLVED,
                task="pair_map",
            )
        )
    ball = partial(shapes.ball, 10)
    itself = ["source=mesh.obj", "target=mesh.obj"]
    for name, words, expected, reason in (
        ("ball → ball", [*itself, "landmarks=[[0,0],[60,60],[120,120]]"], SOLVED, ""),
        ("landmark twice", [*itself, "landmarks=[[0,0],[0,60]]"], REFUSED, "both vertex 0"),
        ("landmark that is not there", [*itself, "landmarks=[[0,9999]]"], REFUSED, "9999"),
        ("landmark of text", [*itself, "landmarks=[[a,b]]"], REFUSED, "landmark"),
        ("landmarks side by side", [*itself, "landmarks=[[0,0],[1,1],[20,20],[21,21]]"],
         SOLVED, ""),
        ("target that is not there", ["source=mesh.obj", "target=none.obj"], REFUSED, "no such"),
    ):  # fmt: skip
        result.append(
            Case("mapped", name, partial(_pair, words, ball), expected, reason, task="pair_map")
        )
    result += [
        Case(f.group, name, partial(_of_file, f.make), f.expected, f.reason)
        for name, f in files.FILES.items()
    ]
    result += [
        Case("disks", "no file above 100 kB", partial(_to_disk, []), REFUSED, "", limit=100_000),
        Case("disks", "no file above 2 kB", partial(_to_disk, []), REFUSED, "", limit=2_000),
        Case("disks", "outputs is a file", _outputs_in_the_way, REFUSED, "outputs"),
        Case("disks", "cache is a file", partial(_to_disk, []), SOLVED,
             environment={"NSM_CACHE": "mesh.obj"}),
        Case("disks", "cache in /proc", partial(_to_disk, []), SOLVED,
             environment={"NSM_CACHE": "/proc/nsm"}),
        Case("disks", "full, 64 kB", partial(_to_disk, ["hydra.run.dir=disk/run"]), REFUSED, "",
             around=partial(_small_disk, "64k")),
        Case("disks", "full cache", partial(_to_disk, []), SOLVED,
             environment={"NSM_CACHE": "disk"}, around=partial(_small_disk, "16k")),
        Case("disks", "read-only", partial(_to_disk, ["hydra.run.dir=disk/run"]), REFUSED, "",
             around=_read_only_disk),
        Case("disks", "read-only cache", partial(_to_disk, []), SOLVED,
             environment={"NSM_CACHE": "disk"}, around=_read_only_disk),
    ]  # fmt: skip
    return result


def limits(memory: int, seconds: int, file_size: int | None) -> None:
    """Limit this process: bytes of address space, seconds of processor time, bytes per file."""
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 10))
    if file_size is not None:
        import signal

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # an OSError then, as on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
