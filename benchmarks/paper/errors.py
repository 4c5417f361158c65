"""Errors of this room."""

from subterra_jax.host.errors import SubterraError


class PaperError(SubterraError):
    """A figure cannot be made: an input is missing, or a command that makes it failed."""
