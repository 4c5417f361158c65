"""Errors of this room."""

from subterra_jax.errors import SubterraError


class ReproduceError(SubterraError):
    """A number cannot be measured again."""
