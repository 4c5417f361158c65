"""What can go wrong with a request to the suite."""


class FidelityError(Exception):
    """A user's mistake; its text is one sentence that names the file and the cause."""
