"""What a user of this benchmark can get wrong."""

from subterra_jax.errors import SubterraError


class RaysError(SubterraError):
    """A comparison that cannot be made."""
