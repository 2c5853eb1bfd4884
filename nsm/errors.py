"""The one exception that users see: bad input, or a request that cannot be met."""

from __future__ import annotations


class NsmError(Exception):
    """Bad input, in one line: which file or setting, what is wrong, how to mend it.

    The command line prints the message without a traceback and exits with status 2.

    Args:
        message: the line.
        kind: what is wrong, as a slug that does not change with the wording, such as
            ``unknown_setting`` or ``missing_file``; programs and tests look at it.
        key: the setting, argument or file concerned, if there is one.
    """

    def __init__(self, message: str, *, kind: str = "bad_input", key: str | None = None) -> None:
        super().__init__(message)
        self.kind, self.key = kind, key


class NotRegistered(NsmError):
    """A file names something that is neither nsm's nor registered in this process."""

    def __init__(self, kind: str, name: object, register: str) -> None:
        super().__init__(
            f"it was made with the {kind} {str(name)[:60]!r}, which is not known here; if it is "
            f"your own, call nsm.{register} first",
            kind="not_registered",
            key=str(name)[:60],
        )


class NotTrusted(NsmError):
    """A stored file names code outside nsm and torch that the user has not said to trust."""

    def __init__(self, target: str) -> None:
        module = target.split(".")[0]
        super().__init__(
            f"it names {target[:80]!r}, which is not nsm's: loading would run code of the module "
            f"{module[:60]!r}; if you trust it, give trust={module[:60]} (nsm report and nsm view: "
            f"--trust {module[:60]})",
            kind="not_trusted",
            key=module,
        )


def of_disk(error: OSError) -> str:
    """What the system said of a file or folder: where, and what is wrong."""
    place = f"{error.filename}: " if error.filename else ""
    return place + (error.strerror or " ".join(str(error).split()) or type(error).__name__)
