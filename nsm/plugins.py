"""The user's own modules: what they register with nsm is known to the command as well."""

from __future__ import annotations

import importlib
import os
import sys

from nsm.errors import NsmError

VARIABLE = "NSM_PLUGINS"


def import_plugins() -> None:
    """Import the modules that the environment variable NSM_PLUGINS names, separated by commas.

    They call ``nsm.register_energy`` and its like. It is the only way to let the command import
    code, and it is the user's: no setting, and so no file from a stranger, can name a module. They
    are looked for in the current folder as well.

    Raises:
        NsmError: a module that is not there, or that fails.
    """
    names = [name.strip() for name in os.environ.get(VARIABLE, "").split(",") if name.strip()]
    if names and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # whatever a user's module raises
            reason = " ".join(str(error).split())[:150] or type(error).__name__
            raise NsmError(f"{VARIABLE}: module {name!r} cannot be imported ({reason})") from error
