"""``nsm report``: one page from the results of many runs."""

from __future__ import annotations

from pathlib import Path

from nsm.arguments import Arguments


def main(words: list[str]) -> None:
    """Write the page that the words of the command line ask for.

    Raises:
        NsmError: a folder that is not there, folders without any run, a page that cannot be
            written.
    """
    parser = Arguments(
        prog="nsm report",
        description="Compare runs in one self-contained HTML page, which opens without a network: "
        "a table of the settings that differ against the figures, learning curves, distortion "
        "histograms, pictures side by side and 3D views that turn.",
        epilog="Runs of different tasks may be mixed. Runs that are incomplete or damaged are "
        "listed as such.",
    )
    parser.add_argument(
        "folders",
        nargs="+",
        metavar="FOLDER",
        type=Path,
        help="a run folder, a sweep, or any folder above; searched for runs",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("report.html"), help="default: %(default)s"
    )
    parser.add_argument("--title", default="nsm report", help="default: %(default)s")
    arguments = parser.parse_args(words)
    # torch takes seconds to import: --help and misspelt options need not wait
    from nsm.results.report import write_report

    runs, incomplete = write_report(arguments.folders, arguments.output, arguments.title)
    aside = f", {incomplete} incomplete or damaged" if incomplete else ""
    print(f"{runs} run{'s' if runs != 1 else ''}{aside}: {arguments.output}")
