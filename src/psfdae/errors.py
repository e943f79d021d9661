"""The class of all refusals."""


class Error(Exception):
    """Something that was given cannot be used; the message names it and says what is expected."""
