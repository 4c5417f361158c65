"""What the manifest says of a fitted bore."""

from typing import Any

import numpy as np

from scene.bore import Bore

_STRAIGHT = 1e-5  # 1/m


def facts(bore: Bore) -> dict[str, Any]:
    """Residual, coverage, confidence, alignment and types of section, in the manifest's own types.

    `least_plan_radius` is `None` where the bore is straight; parameters that a type of section lacks are left out.
    """
    axis = bore.axis
    bend = float(np.abs(axis.curvature).max())
    return {
        "residual_rms": float(np.sqrt(np.mean(bore.residual_rms**2))),
        "coverage": float(bore.coverage.mean()),
        "confidence": float(bore.confidence.mean()),
        "least_plan_radius": 1 / bend if bend > _STRAIGHT else None,
        "grade": [float(axis.grade.min()), float(axis.grade.max())],
        "sections": [_section(stretch) for stretch in bore.stretch],
    }


def _section(stretch: np.void) -> dict[str, Any]:
    """One stretch; a straight wall has no radius."""
    values = {name: stretch[name].item() for name in stretch.dtype.names or ()}
    return {name: value for name, value in values.items() if isinstance(value, str) or np.isfinite(value)}
