"""``nsm report``: one HTML page that compares runs."""

from __future__ import annotations

from pathlib import Path

from nsm.arguments import Arguments
from nsm.commands import add_trust
from nsm.loading_libraries import loading_libraries
from nsm.wording import number_of


def main(arguments: list[str]) -> None:
    """Write the page for the arguments of the command line.

    Raises:
        NsmError: wrong arguments, or as :func:`nsm.results.report.write_report`.
    """
    parser = Arguments(
        prog="nsm report",
        description="Compare runs in one self-contained HTML page, which needs no network: a table "
        "of figures and of the settings that differ, learning curves, distortion histograms, "
        "interactive 3D views, and pictures side by side.",
        epilog="The runs may be of different tasks. The page also lists incomplete and damaged "
        "runs.",
    )
    parser.add_argument(
        "folders",
        nargs="+",
        metavar="FOLDER",
        type=Path,
        help="a run folder, a sweep, or a folder that contains some",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("report.html"), help="default: %(default)s"
    )
    parser.add_argument("--title", default="nsm report", help="default: %(default)s")
    parser.add_argument(
        "--up",
        choices=["x", "y", "z", "-x", "-y", "-z"],
        help="the axis of the mesh files that points up, as in --up=-y; default: the runs' own",
    )
    add_trust(parser)
    given = parser.parse_args(arguments)
    # torch takes seconds to import, which --help and wrong options do not need
    with loading_libraries(frozen=True):
        from nsm.results.report import write_report

    runs, incomplete = write_report(given.folders, given.output, given.title, given.trust, given.up)
    others = f", {incomplete} incomplete or damaged" if incomplete else ""
    print(f"{number_of(runs, 'run')}{others}: {given.output}")
