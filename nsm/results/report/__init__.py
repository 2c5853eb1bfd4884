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
    folders: Sequence[Path],
    output: Path,
    title: str = "nsm report",
    trust: Sequence[str] = (),
    up: str | None = None,
) -> tuple[int, int]:
    """Write one page about all runs in folders and their subfolders.

    Args:
        folders: to search for runs.
        output: the HTML file.
        title: of the page.
        trust: modules outside nsm whose code the files of the runs may name.
        up: the axis of the mesh files that points up: x, y, z, -x, -y or -z; by default what most
            of the runs have set.

    Returns:
        The numbers of complete and of incomplete runs.

    Raises:
        NsmError: ``missing_folder`` or ``no_runs`` (key: the folder), ``not_a_file`` or
            ``not_writable`` (key: the output).
    """
    if not output.parent.is_dir():
        reason = f"{output}: there is no folder {output.parent}; create it first"
        raise NsmError(reason, kind="missing_folder", key=str(output))
    if output.is_dir():
        reason = f"{output}: is a folder; give a file name for the page"
        raise NsmError(reason, kind="not_a_file", key=str(output))
    runs, incomplete = find_runs(folders)
    text = page(title, content(title, runs, incomplete, trust, up))
    try:
        atomic_write(output, text.encode())
    except OSError as error:
        reason = f"{output}: {error.strerror}; give another --output"
        raise NsmError(reason, kind="not_writable", key=str(output)) from error
    return len(runs), len(incomplete)
