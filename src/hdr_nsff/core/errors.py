"""The one exception that the user can fix: the command line prints its sentence and
exits with code 2.
"""


class InputError(ValueError):
    """Bad input. The message says in one sentence what is wrong, where, and how to fix
    it.
    """
