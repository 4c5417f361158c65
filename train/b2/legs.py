"""What `train.navigate --embodiment b2` is told about the legs."""

import dataclasses
from typing import Literal

from subterra_jax.b2.gait import RELEASED


@dataclasses.dataclass(frozen=True)
class Legs:
    """The trial on four legs after training.

    Attributes:
        gait: A file, the name of a released gait, or `trot`.
        robots: How many walk; 0 leaves the trial out.
        engine: `mjx`, or `mujoco` in C on the host.
    """

    gait: str = RELEASED
    robots: int = 100
    engine: Literal["mjx", "mujoco"] = "mjx"
