"""Rigid transforms between the instruments of the rack."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Mount:
    """How one instrument sits against another: p_instrument = rotation @ p_other + shift.

    Attributes:
        rotation: `(3, 3)`.
        shift: m, `(3,)`.
    """

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """The instrument's origin in the other's coordinates, m."""
        return -self.rotation.T @ self.shift

    def after(self, first: "Mount") -> "Mount":
        """`first`, then this one."""
        return Mount(self.rotation @ first.rotation, self.rotation @ first.shift + self.shift)

    def inverse(self) -> "Mount":
        """From the instrument's coordinates to the other's."""
        return Mount(self.rotation.T, self.origin)
