"""The one exception that the user can fix: the command line prints its sentence and
exits with code 2.
"""


class InputError(ValueError):
    """Bad input. The message says in one sentence what is wrong, where, and how to fix
    it.
    """


def shorten(text: object, limit: int = 80) -> str:
    """`text` as a message quotes it: on one line, and of more than `limit` characters
    the beginning and the end.
    """
    line = " ".join(str(text).split())
    if len(line) <= limit:
        return line
    half = (limit - 3) // 2
    return f"{line[:half]}...{line[-half:]}"
