"""The one exception that means "your input", as opposed to "our bug".

The command line turns it into exit code 2 and a single message; everything else is exit code 1.
"""


class InputError(ValueError):
    """Something the user or a file gave is wrong; the message says what, where, expected, found and the way out."""
