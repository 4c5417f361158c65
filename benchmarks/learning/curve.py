"""Finished episodes of one training run, and when its last hundred met the goal."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from train.curve import GOAL, rolling
from train.run.episodes import WINDOW


@dataclasses.dataclass(frozen=True)
class Curve:
    """One run.

    Attributes:
        name: Whose.
        step: Environment steps when each episode ended.
        seconds: Wall clock then, from the first step on, s.
        coverage: Share of the tunnel that each covered.
        success: Whether it succeeded.
        compiling: Before the first step, s.
    """

    name: str
    step: Int[np.ndarray, "episodes"]
    seconds: Float[np.ndarray, "episodes"]
    coverage: Float[np.ndarray, "episodes"]
    success: Bool[np.ndarray, "episodes"]
    compiling: float = 0.0

    def reached(self) -> dict[str, float] | None:
        """Episodes, steps and seconds until the last hundred covered 90 % and all succeeded; None if they never did."""
        holds = (rolling(self.coverage) >= GOAL) & (rolling(self.success.astype(float)) >= 1.0)
        holds[: WINDOW - 1] = False
        if not holds.any():
            return None
        first = int(np.argmax(holds))
        return {"episodes": first + 1, "steps": int(self.step[first]), "seconds": float(self.seconds[first])}
