"""`InputError`: the one exception for faults that the user can fix.

The command line prints its sentence and exits with code 2.
"""


class InputError(ValueError):
    """Bad input. One sentence says what is wrong, where, and how to fix it."""


class NoSceneError(InputError):
    """Pictures of which no scene can be made, though the settings make sense."""


def shorten(text: object, limit: int = 80) -> str:
    """`text` as a message quotes it: on one line, with at most `limit` characters.

    Of a longer text, the beginning and the end stay.
    """
    line = " ".join(str(text).split())
    if len(line) <= limit:
        return line
    half = (limit - 3) // 2
    return f"{line[:half]}...{line[-half:]}"


def check_number(option: str, value: float, least: float, most: float) -> None:
    """InputError for the value of an `option` that is not from `least` to `most`."""
    if not least <= value <= most:
        raise InputError(
            f"{option} {shorten(value)}: it must be a number from {least:g} to {most:g}"
        )
