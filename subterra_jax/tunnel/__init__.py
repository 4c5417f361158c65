"""A tunnel in the plane: from a file, a plan or arrays to the pytree that every step reads."""

from subterra_jax.tunnel.arrays import from_centreline, from_polylines
from subterra_jax.tunnel.tunnel import CONTACT_REACH, GROUP, WIDTH, Foot, Tunnel, at_station, beside, foot, node_at

__all__ = [
    "CONTACT_REACH",
    "GROUP",
    "WIDTH",
    "Foot",
    "Tunnel",
    "at_station",
    "beside",
    "foot",
    "from_centreline",
    "from_polylines",
    "node_at",
]
