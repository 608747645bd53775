"""The one exception that is the user's to mend: the command line prints its sentence
and exits with code 2.
"""


class InputError(ValueError):
    """Bad input. The message says what is wrong, where, and how to mend it, in one
    sentence without a traceback.
    """
