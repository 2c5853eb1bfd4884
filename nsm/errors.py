"""The one exception that users see: bad input or a request that cannot be met."""


class NsmError(Exception):
    """Bad input, told in one line: which file or setting, what is wrong, how to mend it.

    The command line prints the message without a traceback and exits with status 2.
    """


class NotRegistered(NsmError):
    """A file names something that is neither nsm's nor registered in this process."""

    def __init__(self, kind: str, name: object, register: str) -> None:
        super().__init__(
            f"it was made with the {kind} {str(name)[:60]!r}, which is not known here; if it is "
            f"one of your own, call nsm.{register} first"
        )


def of_disk(error: OSError) -> str:
    """What the system said of a file or folder: where, and what is wrong."""
    place = f"{error.filename}: " if error.filename else ""
    return place + (error.strerror or " ".join(str(error).split()) or type(error).__name__)
