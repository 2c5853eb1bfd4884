"""Packages that an extra of nsm installs."""

from __future__ import annotations

import importlib
from typing import Any

from nsm.errors import NsmError


def needed(package: str, what: str, extra: str | None = None) -> Any:
    """Import a package of an extra.

    Args:
        package: its name.
        what: what needs it, for the message.
        extra: the name of the extra, by default that of the package.


    Raises:
        NsmError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        command = f"pip install 'nsm[{extra or package}]'"
        raise NsmError(
            f"{what} needs {package}: {command}", kind="missing_package", key=package
        ) from error
