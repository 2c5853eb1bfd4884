"""``nsm view``: a run's shapes in the browser."""

from __future__ import annotations

import time
from pathlib import Path

from nsm.arguments import Arguments
from nsm.optional_dependencies import needed


def main(words: list[str]) -> None:
    """Serve the viewer until it is interrupted.

    Raises:
        NsmError: viser is not installed, a folder without a result, a port or address that cannot
            be used.
        KeyboardInterrupt: the end.
    """
    parser = Arguments(
        prog="nsm view",
        description="Turn a run's shapes in the browser: a mesh beside its neural surface or its "
        "flattening, or both surfaces of a map (of a collection, any pair). A click on one marks "
        "the point and its image on the other.",
        epilog="There is no password: whoever reaches the port sees the shapes. From elsewhere, "
        "ssh -L 8080:localhost:8080 MACHINE forwards the port.",
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="a run folder")
    parser.add_argument(
        "--port", type=int, default=8080, help="default: %(default)s; 0 for any that is free"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; default: %(default)s, this machine alone; 0.0.0.0 for all",
    )
    arguments = parser.parse_args(words)
    needed("viser", "nsm view", "view")
    # torch takes seconds to import: --help and misspelt options need not wait
    from nsm.api import load
    from nsm.results.view import serving

    result = load(arguments.folder)
    with serving(result, arguments.host, arguments.port) as (_, address):
        print(f"{arguments.folder}: {address} (Ctrl-C ends)", flush=True)
        while True:
            time.sleep(3600)
