"""The report: one self-contained HTML page that compares runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nsm.errors import NsmError
from nsm.results.files import atomic_write
from nsm.results.report.content import content
from nsm.results.report.page import page
from nsm.results.report.runs import find_runs


def write_report(
    folders: Sequence[Path], output: Path, title: str = "nsm report"
) -> tuple[int, int]:
    """Write the page on all runs in folders, however deep; how many are complete and not.

    Raises:
        NsmError: a folder that is not there, folders without any run, a page that cannot be
            written.
    """
    if not output.parent.is_dir():
        raise NsmError(f"{output}: there is no folder {output.parent}; make it first")
    if output.is_dir():
        raise NsmError(f"{output} is a folder; give a file name for the page")
    runs, incomplete = find_runs(folders)
    text = page(title, content(title, runs, incomplete))
    try:
        atomic_write(output, text.encode())
    except OSError as error:
        raise NsmError(f"{output}: {error.strerror}; give another --output") from error
    return len(runs), len(incomplete)
