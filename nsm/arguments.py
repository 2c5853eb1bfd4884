"""Command lines, with mistakes answered in one line."""

from __future__ import annotations

import argparse
from typing import NoReturn

from nsm.errors import NsmError


class Arguments(argparse.ArgumentParser):
    """An argparse parser that raises :class:`NsmError` where argparse prints its usage."""

    def error(self, message: str) -> NoReturn:
        raise NsmError(f"{message}; see {self.prog} --help", kind="bad_argument")
