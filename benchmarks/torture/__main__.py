"""Try the command on everything that is hard to bear: ``make torture``.

Each case runs ``nsm`` in a process (forked from one that has imported the libraries, so that 250 of
them take minutes instead of hours) and folder of its own, within limits of time and memory, and
must end in a result that is right (:mod:`torture.check`) or in one line on stderr with status 2 and
nothing left behind. Keeps what came of each in benchmarks/results/torture.json, prints a table, and
writes it into docs/robustness.md once every case is there; status 1 if any case failed.

    python benchmarks/torture [--only WORD ...] [--skip WORD ...] [--jobs N]
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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

os.environ["OMP_NUM_THREADS"] = "1"  # before anything starts threads, which forks would lose
sys.path.insert(0, str(Path(__file__).parents[1]))

import nsm.pipeline  # noqa: F401  imported once, for all processes
from nsm import cli
from nsm.pipeline.folder_lock import LOCK_FILE
from torture import check
from torture.cases import BARE, OVERFIT, Case, all_cases, limits, may_mount
from torture.shapes import REFUSED, SOLVED

RESULT = Path(__file__).parents[1] / "results" / "torture.json"
PAGE = Path(__file__).parents[2] / "docs" / "robustness.md"
SECONDS = 300  # of a processor, a case
SLACK = 5  # times these, on a machine that is busy: then it hangs
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
            _be_the_command(self, words)

    def result(self) -> dict[str, Any] | None:
        """What came of it; None while it runs."""
        done, status, used = os.wait4(self.process, os.WNOHANG)
        spent = time.monotonic() - self.started
        if not done and spent < SLACK * self.seconds:
            return None
        case = self.case
        if not done:
            os.kill(self.process, signal.SIGKILL)
            used = os.wait4(self.process, 0)[2]
            outcome, reason, complaints = FAILED, "", [f"not done after {spent:.0f} s"]
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
            "cpu_seconds": round(used.ru_utime + used.ru_stime, 1),
            "complaints": complaints,
        }


def _be_the_command(trial: Trial, words: Sequence[str]) -> NoReturn:
    """Become ``nsm WORDS``, in the trial's folder and within its limits; never come back."""
    os.dup2(trial.said.fileno(), 1)
    os.dup2(trial.told.fileno(), 2)
    # whoever forked may have put others in their place
    sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
    status = 1
    try:
        os.chdir(trial.folder)
        os.environ.update({"NSM_CACHE": "cache", **trial.case.environment})
        limits(MEMORY, trial.seconds, trial.case.limit)
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
    if status == -signal.SIGXCPU:
        complaints.append("not done within its limit of processor time")
    elif status != 2:
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
    kept = file.name in ("config.yaml", "last.ckpt", LOCK_FILE) or "tensorboard" in file.parts
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
    parser.add_argument("--skip", nargs="*", default=(), help="words that no case's name may have")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    options = parser.parse_args()
    mounts = may_mount()
    every = [
        (case, SECONDS_OF_MILLION if "million" in case.name else SECONDS)
        for case in all_cases()
        if mounts or case.around is None
    ]
    every += _shared(options.meshes.resolve())
    chosen = [
        (case, seconds)
        for case, seconds in every
        if (not options.only or _has_one(case, options.only)) and not _has_one(case, options.skip)
    ]
    kept = _kept()
    failed = []
    for result in _tried(chosen, options.jobs):
        print(_line(result), flush=True)
        kept[result["group"], result["case"]] = result
        if result["outcome"] == FAILED:
            failed.append(result)
        _keep(kept, mounts)

    names = [(case.group, case.name) for case, _ in every]
    missing = [name for name in names if name not in kept]
    # those of another machine, with meshes that are not at hand here, stand behind
    ordered = {name: kept[name] for name in [*names, *kept] if name in kept}
    results = list(ordered.values())
    _keep(ordered, mounts)
    print("\n" + table(results))
    for result in failed:
        print(f"failed: {_line(result)}")
    if missing:
        print(f"{len(missing)} cases have not been tried yet")
    else:
        RESULT.with_suffix(".md").write_text(f"{table(results)}\n\n{reasons(results)}\n")
        _show(table(results))
    sys.exit(1 if failed else 0)


def _has_one(case: Case, words: Sequence[str]) -> bool:
    return any(word in f"{case.group}: {case.name}" for word in words)


def _tried(todo: Sequence[tuple[Case, int]], jobs: int) -> Iterator[dict[str, Any]]:
    """Run cases, so many at a time, and give what came of each."""
    queue = list(todo)[::-1]
    running: list[Trial] = []
    while queue or running:
        while queue and len(running) < jobs:
            running.append(Trial(*queue.pop()))
        for trial in list(running):
            result = trial.result()
            if result is not None:
                running.remove(trial)
                yield result
        time.sleep(0.02)


def _line(result: dict[str, Any]) -> str:
    end = "; ".join(filter(None, [result["reason"], *result["complaints"]]))
    name = f"{result['group']}: {result['case']}"
    return f"{result['outcome']:8} {result['seconds']:6.1f} s  {name}  {end}".rstrip()


def _kept() -> dict[tuple[str, str], dict[str, Any]]:
    """What came of cases before, by group and name."""
    if not RESULT.exists():
        return {}
    return {(r["group"], r["case"]): r for r in json.loads(RESULT.read_text())["cases"]}


def _keep(results: Mapping[tuple[str, str], dict[str, Any]], mounts: bool) -> None:
    words = {
        "limits": {
            "seconds": SECONDS,
            "seconds_of_a_million_faces": SECONDS_OF_MILLION,
            "bytes_of_memory": MEMORY,
        },
        "disks_mounted": mounts,
        "cases": list(results.values()),
    }
    RESULT.write_text(json.dumps(words, indent=1, ensure_ascii=False) + "\n")


def _show(text: str) -> None:
    """Put the table into its place in the documentation."""
    before, mark, rest = PAGE.read_text().partition("<!-- table -->\n")
    after = rest.partition("<!-- end -->")[1:]
    PAGE.write_text(before + mark + "\n" + text + "\n\n" + "".join(after))


if __name__ == "__main__":
    main()
