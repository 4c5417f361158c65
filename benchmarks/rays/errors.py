"""What a user of this benchmark can get wrong."""

from subterra_jax.host.errors import SubterraError


class RaysError(SubterraError):
    """A comparison that cannot be made."""
