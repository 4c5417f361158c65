"""What a user can do wrong in the viewer."""

from subterra_jax.errors import SubterraError


class ViewerError(SubterraError):
    """The viewer cannot be started, or cannot show what it was asked for."""


class RecordingError(ViewerError):
    """A recorded episode cannot be read."""
