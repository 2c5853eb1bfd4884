"""The one exception that users see: bad input or a request that cannot be met."""


class NsmError(Exception):
    """Bad input, told in one line: which file or setting, what is wrong, how to mend it.

    The command line prints the message without a traceback and exits with status 2.
    """
