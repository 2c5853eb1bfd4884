"""``nsm view``: the shapes of a run in the browser."""

from __future__ import annotations

import time
from pathlib import Path

from nsm.arguments import Arguments
from nsm.commands import add_address, add_trust
from nsm.loading_libraries import loading_libraries
from nsm.optional_dependencies import needed


def main(arguments: list[str]) -> None:
    """Serve the viewer until Ctrl-C.

    Raises:
        NsmError: wrong arguments, or as :func:`nsm.load` and :func:`nsm.results.view.serving`.
        KeyboardInterrupt: Ctrl-C.
    """
    parser = Arguments(
        prog="nsm view",
        description="Show the result of a run in the browser: a mesh beside its neural surface or "
        "its flattening (of several charts, their atlas), or the two surfaces of a map (of a "
        "collection, any pair). A click on one shape marks the point and its image on the other.",
        epilog="There is no password: anyone who can reach the port can see the shapes. To view "
        "from another machine, forward the port with ssh -L 8080:localhost:8080 MACHINE.",
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="a run folder")
    add_address(parser)
    add_trust(parser)
    given = parser.parse_args(arguments)
    needed("viser", "nsm view", "view")
    # torch takes seconds to import, which --help and wrong options do not need
    with loading_libraries(frozen=True):
        from nsm.result_folders import load
        from nsm.results.view import serving

    result = load(given.folder, trust=given.trust)
    with serving(result, given.host, given.port) as (_, address):
        print(f"{given.folder}: {address} (Ctrl-C ends)", flush=True)
        while True:
            time.sleep(3600)
