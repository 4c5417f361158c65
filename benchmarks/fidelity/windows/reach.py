"""Checks before anything is judged: the recording lies in the scene's frame and shows all of the tunnel."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.references import Hold
from benchmarks.fidelity.windows.measures import LONG

_BESIDE = 2.0  # largest radii from the axis at which a sensor or a return is still in the tunnel
_FEWEST = 30  # returns that show a metre of the tunnel
_SHOWN = 0.95  # share of the tunnel that must be shown
_THINNED = 200_000  # returns that are looked at


def check_length(candidate: Candidate, scene: Path) -> None:
    """Refuses a tunnel that is shorter than a window."""
    if candidate.length < LONG:
        raise FidelityError(
            f"{scene}: its tunnel is {candidate.length:.1f} m long, and a window along it {LONG:g} m; "
            "a shorter tunnel cannot be judged by windows"
        )


def check_recording(candidate: Candidate, hold: Hold, scene: Path, recording: Path, partial: bool = False) -> None:
    """Refuses a recording in another frame, or one that shows only a part of the tunnel.

    Args:
        candidate: Scene to be judged.
        hold: Recording in the tunnel frame.
        scene: Folder of the scene, for the sentence.
        recording: File of the recording, for the sentence.
        partial: Accept a recording of a part.
    """
    line = Curve(candidate.bore.station, candidate.bore.position)
    first = np.unique(hold.scan, return_index=True)[1]
    local = line.local(hold.origin[first])
    reach = _BESIDE * float(np.nanmax(candidate.bore.radius))
    beyond = np.maximum(np.maximum(-local[:, 0], local[:, 0] - candidate.length), 0.0)
    away = float(np.median(np.hypot(np.hypot(local[:, 1], local[:, 2]), beyond)))
    if away > reach:
        raise FidelityError(
            f"{recording}: its sensor lies {away:.0f} m from the tunnel of {scene}; "
            "its poses are not in the frame of the scene's input"
        )
    shown = _shown_metres(line, hold, reach)
    if not partial and shown.mean() < _SHOWN:
        gaps = np.flatnonzero(~shown)
        raise FidelityError(
            f"{recording}: shows {int(shown.sum())} of the {len(shown)} m of {scene}, nothing for instance at station "
            f"{gaps[len(gaps) // 2]} m; what is not shown cannot be judged (--partial judges the rest)"
        )


def _shown_metres(line: Curve, hold: Hold, reach: float) -> Bool[np.ndarray, " m"]:
    """Return True for each metre of the tunnel with returns on it."""
    points = hold.points
    thin = max(len(points) // _THINNED, 1)
    local = line.local(points[::thin])
    near = np.hypot(local[:, 1], local[:, 2]) < reach
    count = max(int(line.length), 1)
    metre = np.floor(local[near, 0] / line.length * count).astype(int)
    inside = (metre >= 0) & (metre < count)
    return np.bincount(metre[inside], minlength=count) * thin >= _FEWEST
