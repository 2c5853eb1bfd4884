"""Packages that come with an extra of nsm, and not without it."""

from __future__ import annotations

import importlib
from typing import Any

from nsm.errors import NsmError


def needed(package: str, what: str, extra: str | None = None) -> Any:
    """A package of an extra, which is called as the package is unless it is named.

    Raises:
        NsmError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        mend = f"pip install 'nsm[{extra or package}]'"
        raise NsmError(f"{what} needs {package}: {mend}") from error
