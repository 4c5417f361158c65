"""What a user can get wrong, as exceptions with one clear sentence."""


class SubterraError(Exception):
    """Base of every error that a user can cause; the commands print it and exit with status 2."""


class RecordingError(SubterraError):
    """An input cannot be read, or is not what it says it is."""


class FitError(SubterraError):
    """The input was read, but no tunnel can be found or measured in it."""


class OutputError(SubterraError):
    """The output cannot be written where it was asked for."""
