"""Run the command on difficult meshes, files and disks: ``make torture``.

Each case runs ``nsm`` in a separate folder and process, with limits of time and memory. The process
is forked from one that has imported the libraries, so 250 cases take minutes instead of hours. A
case must end with a correct result (:mod:`torture.check`), or with one line on stderr, status 2 and
no result. The outcomes are kept in benchmarks/results/torture.json; a table of them is printed and,
once all cases have run, written to docs/robustness.md. The status is 1 if any case failed.

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

os.environ["OMP_NUM_THREADS"] = "1"  # before any thread starts, which a fork would lose
sys.path.insert(0, str(Path(__file__).parents[1]))

import nsm.pipeline  # noqa: F401  imported once for all processes
from nsm import cli
from nsm.pipeline.folder_lock import LOCK_FILE
from torture import check
from torture.cases import BARE, OVERFIT, Case, all_cases, limits, may_mount
from torture.shapes import REFUSED, SOLVED

RESULT = Path(__file__).parents[1] / "results" / "torture.json"
PAGE = Path(__file__).parents[2] / "docs" / "robustness.md"
SECONDS = 300  # of processor time per case
SLACK = 5  # a case hangs if it takes this many times longer on the clock
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
    """A running case: its folder and process."""

    case: Case
    seconds: int
    place: ExitStack = field(default_factory=ExitStack)

    def __post_init__(self) -> None:
        self.folder = Path(self.place.enter_context(tempfile.TemporaryDirectory(prefix="torture-")))
        if self.case.around:
            self.place.enter_context(self.case.around(self.folder))
        words = self.case.prepare(self.folder)
        self.stdout, self.stderr = (
            self.place.enter_context((self.folder / name).open("w+", errors="replace"))
            for name in (".stdout", ".stderr")
        )
        self.before = _files(self.folder)
        self.started = time.monotonic()
        self.process = os.fork()
        if self.process == 0:
            _run_command(self, words)

    def result(self) -> dict[str, Any] | None:
        """The outcome; None while the case runs."""
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
            for stream in (self.stderr, self.stdout):
                stream.seek(0)
            code = os.waitstatus_to_exitcode(status)
            left = _files(self.folder) - self.before
            outcome, reason, complaints = _judge(
                case, code, self.stdout.read(), self.stderr.read(), self.folder, left
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


def _run_command(trial: Trial, words: Sequence[str]) -> NoReturn:
    """Run ``nsm WORDS`` in the trial's folder, within its limits, and exit."""
    os.dup2(trial.stdout.fileno(), 1)
    os.dup2(trial.stderr.fileno(), 2)
    # the parent process may have replaced them
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


def _judge(
    case: Case, status: int, stdout: str, stderr: str, folder: Path, left: set[Path]
) -> tuple[str, str, list[str]]:
    """The outcome, the message of a refusal, and complaints."""
    lines = stderr.strip().splitlines()
    complaints = []
    if "Traceback" in stdout + stderr:
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
    """Whether a file suggests a finished run.

    A training interrupted by a full disk keeps its settings and its checkpoint, to be resumed.
    """
    kept = file.name in ("config.yaml", "last.ckpt", LOCK_FILE) or "tensorboard" in file.parts
    return "cache" not in file.parts and not kept


def _files(folder: Path) -> set[Path]:
    return {p for p in folder.rglob("*") if p.is_file() and not p.is_symlink()}


def _classic_models(folder: Path) -> Iterator[tuple[Case, int]]:
    """The classic models in a folder, with their limits of time."""
    for name, seconds in SHARED.items():
        file = folder / name
        if file.is_file():
            words = [f"surface.path={file}", *OVERFIT, *BARE]
            yield Case("classic models", name, lambda _, w=words: w, SOLVED), seconds


def table(results: Sequence[dict[str, Any]]) -> str:
    """The counts of outcomes by group, as a Markdown table."""
    lines = ["| what | tried | solved | refused | failed |", "|---|---|---|---|---|"]
    groups = list(dict.fromkeys(r["group"] for r in results))
    for group in [*groups, None]:
        rows = [r for r in results if group in (r["group"], None)]
        counts = [sum(r["outcome"] == o for r in rows) for o in (SOLVED, REFUSED, FAILED)]
        cells = [group or "**all**", len(rows), *counts]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def reasons(results: Sequence[dict[str, Any]]) -> str:
    """The messages of refused cases, as a Markdown table."""
    lines = ["| case | message |", "|---|---|"]
    for r in results:
        if r["outcome"] == REFUSED:
            message = r["reason"].replace("|", "\\|").replace("<", "&lt;")
            lines.append(f"| {r['case']} | {message} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", help="words, one of which a case's name must contain")
    parser.add_argument(
        "--skip", nargs="*", default=(), help="words that a case's name must not contain"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    options = parser.parse_args()
    mounts = may_mount()
    every = [
        (case, SECONDS_OF_MILLION if "million" in case.name else SECONDS)
        for case in all_cases()
        if mounts or case.around is None
    ]
    every += _classic_models(options.meshes.resolve())
    chosen = [
        (case, seconds)
        for case, seconds in every
        if (not options.only or _matches(case, options.only)) and not _matches(case, options.skip)
    ]
    kept = _kept()
    failed = []
    for result in _run_all(chosen, options.jobs):
        print(_line(result), flush=True)
        kept[result["group"], result["case"]] = result
        if result["outcome"] == FAILED:
            failed.append(result)
        _keep(kept, mounts)

    names = [(case.group, case.name) for case, _ in every]
    missing = [name for name in names if name not in kept]
    # cases of meshes that this machine lacks come last
    ordered = {name: kept[name] for name in [*names, *kept] if name in kept}
    results = list(ordered.values())
    _keep(ordered, mounts)
    print("\n" + table(results))
    for result in failed:
        print(f"failed: {_line(result)}")
    if missing:
        print(f"{len(missing)} cases have not been run yet")
    else:
        RESULT.with_suffix(".md").write_text(f"{table(results)}\n\n{reasons(results)}\n")
        _write_table(table(results))
    sys.exit(1 if failed else 0)


def _matches(case: Case, words: Sequence[str]) -> bool:
    return any(word in f"{case.group}: {case.name}" for word in words)


def _run_all(todo: Sequence[tuple[Case, int]], jobs: int) -> Iterator[dict[str, Any]]:
    """Run cases, ``jobs`` at a time, and give the outcome of each."""
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
    """The stored outcomes by group and name."""
    if not RESULT.exists():
        return {}
    return {(r["group"], r["case"]): r for r in json.loads(RESULT.read_text())["cases"]}


def _keep(results: Mapping[tuple[str, str], dict[str, Any]], mounts: bool) -> None:
    content = {
        "limits": {
            "seconds": SECONDS,
            "seconds_of_a_million_faces": SECONDS_OF_MILLION,
            "bytes_of_memory": MEMORY,
        },
        "disks_mounted": mounts,
        "cases": list(results.values()),
    }
    RESULT.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _write_table(text: str) -> None:
    """Write the table into the documentation."""
    before, mark, rest = PAGE.read_text().partition("<!-- table -->\n")
    after = rest.partition("<!-- end -->")[1:]
    PAGE.write_text(before + mark + "\n" + text + "\n\n" + "".join(after))


if __name__ == "__main__":
    main()
