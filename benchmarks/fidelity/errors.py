"""What can go wrong with a request to the suite."""

from scene.errors import SubterraError


class FidelityError(SubterraError):
    """A user's mistake; its text is one sentence that names the file and the cause."""
