"""The user's own modules: where they are found, and those that register something."""

from __future__ import annotations

import importlib
import os
import sys

from nsm.errors import NsmError

VARIABLE = "NSM_PLUGINS"


def import_here() -> None:
    """Let ``_target_`` name modules in the current folder; all others take precedence."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def import_plugins() -> None:
    """Import the modules that the environment variable NSM_PLUGINS names, separated by commas.

    They call ``nsm.register_activation`` and its like. No file from a stranger can name one. They
    are looked for in the current folder as well.

    Raises:
        NsmError: a module that is not there, or that fails.
    """
    names = [name.strip() for name in os.environ.get(VARIABLE, "").split(",") if name.strip()]
    if names:
        import_here()
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # whatever a user's module raises
            reason = " ".join(str(error).split())[:150] or type(error).__name__
            raise NsmError(
                f"{VARIABLE}: module {name!r} cannot be imported ({reason})",
                kind="not_importable",
                key=VARIABLE,
            ) from error
