"""Commands other than tasks: ``nsm COMMAND ...``, each a module with ``main(arguments)``."""

from __future__ import annotations

from argparse import ArgumentParser


def add_address(parser: ArgumentParser) -> None:
    """Add ``--port`` and ``--host`` of a page in the browser."""
    parser.add_argument(
        "--port", type=int, default=8080, help="default: %(default)s; 0 for any free port"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; default: %(default)s, this machine only; 0.0.0.0 for all",
    )


def add_trust(parser: ArgumentParser) -> None:
    """Add ``--trust MODULE``, repeated or with commas, which gives a list of modules."""
    parser.add_argument(
        "--trust",
        action="extend",
        type=lambda modules: [module.strip() for module in modules.split(",") if module.strip()],
        default=[],
        metavar="MODULE",
        help="a module outside nsm whose code the files of a run may name, such as your own "
        "network's; repeat it or use commas for several",
    )
