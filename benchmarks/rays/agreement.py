"""How well ranges agree with those of a reference, with and without the rays that pass an edge."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

# The goals of the issue: half of all rays within the first, 99.9 % within the second, m.
MEDIAN_GOAL, TAIL_GOAL, TAIL_SHARE = 1e-3, 1e-2, 0.999
# A ray passes an edge where the reference's own range jumps by more than this (m) as the ray turns by that (rad).
EDGE_JUMP, EDGE_TURN = 0.05, 1e-4
_PERCENTILES = (50.0, 90.0, 99.0, 99.9)
_WORST = 10


@dataclasses.dataclass(frozen=True)
class Agreement:
    """One comparison.

    Attributes:
        title: What was compared with what.
        error: Absolute differences, m, `(k,)`.
        edge: Rays that pass an edge, `(k,)`.
        range: By the reference, m, `(k,)`.
        station: Of the LiDAR, m, `(k,)`.
        judged: Whether the goals apply; else the figures are for information.
    """

    title: str
    error: Float[np.ndarray, "k"]
    edge: Bool[np.ndarray, "k"]
    range: Float[np.ndarray, "k"]
    station: Float[np.ndarray, "k"]
    judged: bool = True

    @property
    def holds(self) -> bool:
        """Whether the goals are met by all rays, those that pass an edge included; true where they do not apply."""
        met = np.median(self.error) < MEDIAN_GOAL and np.mean(self.error < TAIL_GOAL) >= TAIL_SHARE
        return bool(met) or not self.judged

    def figures(self) -> dict[str, Any]:
        """What the report says of it; lengths in m, stations of the worst rays that pass no edge."""
        plain = np.flatnonzero(~self.edge)
        worst = plain[np.argsort(-self.error[plain], kind="stable")[:_WORST]]
        return {
            "title": self.title,
            "judged": self.judged,
            "holds": self.holds,
            "n_rays": len(self.error),
            "n_edge": int(self.edge.sum()),
            "all": _percentiles(self.error),
            "without_edges": _percentiles(self.error[plain]),
            "worst": [
                {"station": float(self.station[k]), "range": float(self.range[k]), "error": float(self.error[k])}
                for k in worst
            ],
        }


def _percentiles(error: Float[np.ndarray, "k"]) -> dict[str, float]:
    if not len(error):
        return {}
    named = {f"p{q:g}": float(value) for q, value in zip(_PERCENTILES, np.percentile(error, _PERCENTILES), strict=True)}
    return {**named, "max": float(error.max()), "within_1cm": float(np.mean(error < TAIL_GOAL))}
