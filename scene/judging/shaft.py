"""A cloud that is longest along its own z: a tunnel stored with y up, or a vertical shaft, as its section tells."""

import numpy as np

from scene.bore import Bore
from scene.judging.codes import Code
from scene.judging.judge import Warned

_EVEN = 0.05  # m rms: a section that differs less from itself upside down has neither floor nor crown
_GUESSED = "longest along z"  # as `scene.reading.source` says it


def doubt_shaft(bore: Bore, axes: str) -> list[Warned]:
    """Warn of a guess that y is up; refuse the bore where its section is the same upside down, as that of a shaft.

    Args:
        bore: The bore as built.
        axes: Axes that were taken, and why, as the manifest has it.
    """
    if _GUESSED not in axes:
        return []
    section = np.median(bore.radius, axis=0)
    turned = np.interp(-bore.angle, bore.angle, section, period=2 * np.pi)
    even = float(np.sqrt(np.mean((section - turned) ** 2))) < _EVEN
    size = f"{bore.length:.0f} m along z and {bore.width.mean():.1f} m across"
    if even:
        return [Warned(
            Code.SHAFT,
            f"no tunnel in the cloud but a vertical shaft, {size}: its section has neither floor nor crown; if it is a "
            "tunnel, --axes x-zy says that y is up in the file",
            refuses=True,
        )]  # fmt: skip
    return [Warned(
        Code.AXES,
        f"the cloud is {size}, so y was taken as up; if it is a vertical shaft, it is no tunnel, and if z is up, "
        "--axes xyz says so",
    )]  # fmt: skip
