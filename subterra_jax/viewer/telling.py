"""What the viewer says in words."""

import numpy as np

from subterra_jax.viewer.recording import Recording


def headline(recording: Recording, row: int, *, whole: bool, note: str = "") -> str:
    """Who, where, and how it stands at a row, as Markdown; `note` is about the picture of the tunnel."""
    task = recording.task.removeprefix("Subterra/").removesuffix("-v0")
    lines = [
        f"**{task}** · {recording.agent} · seed {int(recording.seed)}  ",
        f"{recording.tunnel}, {recording.lining}, {recording.length:.0f} m  ",
        *([f"<small>{note}</small>"] if note else []),
        "",
        f"station **{recording.station[row]:.1f} m**{_goal(recording)} · {recording.command[row, 0]:.1f} m/s  ",
        _errors(recording, row),
        "",
        _outcome(recording, row, whole),
    ]
    return "\n".join(lines)


def _goal(recording: Recording) -> str:
    return f" of {recording.goal:.1f} m" if np.isfinite(recording.goal) else ""


def _errors(recording: Recording, row: int) -> str:
    """How far off odometry and estimate are along the way."""
    moved = np.linalg.norm(np.diff(recording.position[: row + 1].astype(float), axis=0), axis=1).sum()
    odometry = f"odometry {recording.odometry[row, 0] - moved:+.2f} m"
    station, sigma = recording.estimate[row]
    if not np.isfinite(station):
        return odometry
    return f"{odometry} · estimate {station - recording.station[row]:+.2f} ± {sigma:.2f} m"


def _outcome(recording: Recording, row: int, whole: bool) -> str:
    if not whole:
        return f"*driving, {len(recording) - 1} steps so far*"
    if row < len(recording) - 1:
        return f"{row * recording.period:.1f} s of {recording.duration:.1f} s"
    how = "success" if recording.success else "contact" if recording.contact else "no success"
    return f"**{how}** after {recording.duration:.1f} s"
