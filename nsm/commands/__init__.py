"""Commands other than tasks: ``nsm COMMAND ...``, each a module with ``main(arguments)``."""

from __future__ import annotations

from argparse import ArgumentParser


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
