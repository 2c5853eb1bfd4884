"""Try the command on everything that is hard to bear: ``make torture``.

Each case runs ``nsm`` in a process (forked from one that has imported the libraries, so that 250 of
them take minutes instead of hours) and folder of its own, within limits of time and memory, and
must end in a result that is right (:mod:`torture.check`) or in one line on stderr with status 2 and
nothing left behind. Prints a table, and writes benchmarks/results/torture.json; status 1 if any
case failed.

    python benchmarks/torture [--only WORD ...] [--jobs N]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

os.environ["OMP_NUM_THREADS"] = "1"  # before anything starts threads, which forks would lose
sys.path.insert(0, str(Path(__file__).parents[1]))

import nsm.pipeline  # noqa: F401  imported once, for all processes
from nsm import cli
from torture import check
from torture.cases import BARE, OVERFIT, Case, all_cases, limits, may_mount
from torture.shapes import REFUSED, SOLVED

RESULT = Path(__file__).parents[1] / "results" / "torture.json"
SECONDS = 300  # a case
SECONDS_OF_MILLION = 1200
MEMORY = 6 * 2**30  # bytes of address space
SHARED = {
    "cow.obj": 300, "homer.obj": 300, "suzanne.obj": 300, "stanford-bunny.obj": 600,
    "igea.ply": 1200, "cat_horse-0.obj": 300, "cat_horse-1.obj": 300, "shrec07-381.off": 300,
    "shrec07-384.off": 300, "shrec07-386.off": 300, "shrec07-388.off": 300,
    "shrec07-390.off": 300, "shrec07-393.off": 300,
}  # fmt: skip
FAILED = "failed"


@dataclass
class Trial:
    """A case on its way: its folder, and the process that runs it."""

    case: Case
    seconds: int
    place: ExitStack = field(default_factory=ExitStack)

    def __post_init__(self) -> None:
        self.folder = Path(self.place.enter_context(tempfile.TemporaryDirectory(prefix="torture-")))
        if self.case.around:
            self.place.enter_context(self.case.around(self.folder))
        words = self.case.prepare(self.folder)
        self.said, self.told = (
            self.place.enter_context((self.folder / name).open("w+", errors="replace"))
            for name in (".said", ".told")
        )
        self.before = _files(self.folder)
        self.started = time.monotonic()
        self.process = os.fork()
        if self.process == 0:
            _be_the_command(self.case, words, self.folder, self.said.fileno(), self.told.fileno())

    def result(self) -> dict[str, Any] | None:
        """What came of it; None while it runs."""
        done, status = os.waitpid(self.process, os.WNOHANG)
        spent = time.monotonic() - self.started
        if not done and spent < self.seconds:
            return None
        case = self.case
        if not done:
            os.kill(self.process, signal.SIGKILL)
            os.waitpid(self.process, 0)
            outcome, reason, complaints = FAILED, "", [f"not done within {self.seconds} s"]
        else:
            for stream in (self.told, self.said):
                stream.seek(0)
            code = os.waitstatus_to_exitcode(status)
            left = _files(self.folder) - self.before
            outcome, reason, complaints = _judged(
                case, code, self.said.read(), self.told.read(), self.folder, left
            )
            if outcome != case.expected or case.reason not in reason:
                complaints.append(f"expected: {case.expected} {case.reason}".strip())
        reason = reason.replace(f"{self.folder}/", "")
        self.place.close()
        return {
            "group": case.group,
            "case": case.name,
            "task": case.task,
            "outcome": FAILED if complaints else outcome,
            "reason": reason,
            "seconds": round(spent, 1),
            "complaints": complaints,
        }


def _be_the_command(case: Case, words: Sequence[str], folder: Path, out: int, err: int) -> NoReturn:
    """Become ``nsm WORDS``, in a folder and within limits; never come back."""
    os.dup2(out, 1)
    os.dup2(err, 2)
    status = 1
    try:
        os.chdir(folder)
        os.environ.update({"NSM_CACHE": "cache", **case.environment})
        limits(MEMORY, case.limit)
        sys.argv = ["nsm", *words]
        try:
            cli.main()
            status = 0
        except SystemExit as stop:
            status = int(stop.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)


def _judged(
    case: Case, status: int, said: str, told: str, folder: Path, left: set[Path]
) -> tuple[str, str, list[str]]:
    """Outcome, reason of a refusal, and complaints."""
    lines = told.strip().splitlines()
    complaints = []
    if "Traceback" in said + told:
        complaints.append("a traceback: " + (lines[-1] if lines else ""))
    if status == 0:
        if lines:
            complaints.append(f"on stderr: {lines[0]}")
        runs = [p.parent for p in folder.glob("outputs/*/*/metrics.json")]
        if len(runs) != 1:
            return SOLVED, "", [*complaints, f"{len(runs)} finished runs"]
        mesh = case.mesh() if case.mesh else None
        return SOLVED, "", complaints + check.complaints(runs[0], case.task, mesh)
    if status != 2:
        complaints.append(f"status {status}")
    if len(lines) != 1 or not lines[0].startswith("nsm: "):
        complaints.append(f"{len(lines)} lines on stderr: {lines[-1:]}")
    stray = sorted(str(p.relative_to(folder)) for p in left if p.suffix == ".tmp" or _is_result(p))
    if stray:
        complaints.append(f"left behind: {', '.join(stray[:4])}")
    return REFUSED, lines[0].removeprefix("nsm: ") if lines else "", complaints


def _is_result(file: Path) -> bool:
    """Whether a file pretends that something was finished.

    A training that was under way when the disk became full keeps its settings and its checkpoint,
    to go on from.
    """
    kept = file.name in ("config.yaml", "last.ckpt") or "tensorboard" in file.parts
    return "cache" not in file.parts and not kept


def _files(folder: Path) -> set[Path]:
    return {p for p in folder.rglob("*") if p.is_file() and not p.is_symlink()}


def _shared(folder: Path) -> Iterator[tuple[Case, int]]:
    """The classic models, where they are at hand."""
    for name, seconds in SHARED.items():
        file = folder / name
        if file.is_file():
            words = [f"surface.path={file}", *OVERFIT, *BARE]
            yield Case("classic models", name, lambda _, w=words: w, SOLVED), seconds


def table(results: Sequence[dict[str, Any]]) -> str:
    """Counts by group, as a Markdown table, with the reasons of refusals."""
    lines = ["| what | tried | solved | refused | failed |", "|---|---|---|---|---|"]
    groups = list(dict.fromkeys(r["group"] for r in results))
    for group in [*groups, None]:
        rows = [r for r in results if group in (r["group"], None)]
        counts = [sum(r["outcome"] == o for r in rows) for o in (SOLVED, REFUSED, FAILED)]
        cells = [group or "**all**", len(rows), *counts]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def reasons(results: Sequence[dict[str, Any]]) -> str:
    """What each refused case was told, as a Markdown table."""
    lines = ["| case | told |", "|---|---|"]
    for r in results:
        if r["outcome"] == REFUSED:
            told = r["reason"].replace("|", "\\|").replace("<", "&lt;")
            lines.append(f"| {r['case']} | {told} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", help="words, one of which a case's name must have")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    options = parser.parse_args()
    mounts = may_mount()
    todo = [
        (case, SECONDS_OF_MILLION if "million" in case.name else SECONDS)
        for case in all_cases()
        if mounts or case.around is None
    ]
    todo += _shared(options.meshes.resolve())
    if options.only:
        todo = [(c, s) for c, s in todo if any(w in f"{c.group}: {c.name}" for w in options.only)]

    results: dict[int, dict[str, Any]] = {}
    running: dict[int, Trial] = {}
    queue = list(enumerate(todo))[::-1]
    while queue or running:
        while queue and len(running) < options.jobs:
            k, (case, seconds) = queue.pop()
            running[k] = Trial(case, seconds)
        for k, trial in list(running.items()):
            result = trial.result()
            if result is not None:
                results[k] = result
                del running[k]
                print(_line(result), flush=True)
        time.sleep(0.02)
    listed = [results[k] for k in sorted(results)]
    _finish(listed, mounts, whole=not options.only)


def _line(result: dict[str, Any]) -> str:
    end = "; ".join(filter(None, [result["reason"], *result["complaints"]]))
    name = f"{result['group']}: {result['case']}"
    return f"{result['outcome']:8} {result['seconds']:6.1f} s  {name}  {end}".rstrip()


def _finish(results: Sequence[dict[str, Any]], mounts: bool, *, whole: bool) -> None:
    """Print the table, write the files if it is the whole of it, and end the process."""
    print("\n" + table(results))
    failed = [r for r in results if r["outcome"] == FAILED]
    for r in failed:
        print(f"failed: {r['group']}: {r['case']}: {'; '.join(r['complaints'])}")
    if whole:
        words = {
            "limits": {
                "seconds": SECONDS,
                "seconds_of_a_million_faces": SECONDS_OF_MILLION,
                "bytes_of_memory": MEMORY,
            },
            "disks_mounted": mounts,
            "cases": results,
        }
        text = json.dumps(words, indent=1, ensure_ascii=False)
        RESULT.write_text(text + "\n")
        RESULT.with_suffix(".md").write_text(f"{table(results)}\n\n{reasons(results)}\n")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
