"""A tunnel in the plane: from a file or a plan to the pytree that every step reads."""

from subterra_jax.tunnel.tunnel import CONTACT_REACH, Foot, Tunnel, at_station, foot, node_at

__all__ = ["CONTACT_REACH", "Foot", "Tunnel", "at_station", "foot", "node_at"]
