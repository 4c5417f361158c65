"""The figures of a reconstruction, each one function that returns a Matplotlib figure."""

from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.figure import Figure

from benchmarks.truth import Comparison, Truth

_INK, _TRUTH, _ODOMETRY, _POINTS = "#1b4965", "#c1121f", "#e09f3e", "#8d99ae"
_SLICE = 0.15
_MOST_POINTS = 6_000


@dataclass(frozen=True)
class Axis:
    """A centreline to draw: label, stations (m) and positions in the survey frame (m)."""

    label: str
    station: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]


def plan_and_profile(truth: Truth, given: Axis, odometry: Axis | None) -> Figure:
    """Centrelines from above and from the side."""
    figure, (plan, profile) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    start = truth.position[0]
    direction = truth.position[-1, :2] - start[:2]
    direction /= np.linalg.norm(direction)
    turn = np.array([direction, [-direction[1], direction[0]]])

    def draw(station: np.ndarray, position: np.ndarray, **style: object) -> None:
        along, across = turn @ (position[:, :2] - start[:2]).T
        plan.plot(along, across, **style)
        profile.plot(station, position[:, 2] - start[2], **style)

    draw(truth.station, truth.position, color=_TRUTH, lw=4, alpha=0.4, label="truth (simulated)")
    draw(given.station, given.position, color=_INK, lw=1.4, label=given.label)
    if odometry is not None:
        draw(odometry.station, odometry.position, color=_ODOMETRY, lw=1.4, ls="--", label=odometry.label)
    plan.set(title="Plan", xlabel="along the chord, m", ylabel="across, m")
    plan.set_aspect("equal", adjustable="datalim")
    profile.set(title="Profile", xlabel="station, m", ylabel="height above the start, m")
    plan.legend(fontsize=8)
    for axes in (plan, profile):
        axes.grid(alpha=0.3)
    return figure


def section_overlays(bore_path: Path, points: Float[np.ndarray, "p 3"], count: int = 4) -> Figure:
    """Sections of the bore over the registered points within 15 cm of them.

    Args:
        bore_path: `bore.npz`.
        points: Registered cloud in the tunnel frame, m.
        count: Sections, evenly spread.
    """
    with np.load(bore_path) as data:
        bore = {name: data[name] for name in data.files}
    rows = np.linspace(0, len(bore["station"]) - 1, count + 2).astype(int)[1:-1]
    figure, axes = plt.subplots(1, count, figsize=(3 * count, 4.4), sharey=True, layout="constrained")
    for panel, row in zip(axes, rows, strict=True):
        offset = points - bore["position"][row]
        near = offset[np.abs(offset @ bore["tangent"][row]) < _SLICE]
        near = near[np.linalg.norm(near, axis=1) < 2 * bore["radius"][row].max()]
        near = near[:: max(1, len(near) // _MOST_POINTS)]
        panel.plot(near @ bore["lateral"][row], near @ bore["up"][row], ".", ms=0.8, color=_POINTS, rasterized=True)
        angle, radius = (
            np.append(bore["angle"], bore["angle"][0]),
            np.append(bore["radius"][row], bore["radius"][row][0]),
        )
        panel.plot(radius * np.cos(angle), radius * np.sin(angle), color=_INK, lw=1.2)
        panel.set(title=f"station {bore['station'][row]:.1f} m", xlabel="lateral, m", aspect="equal")
        panel.invert_xaxis()  # looking towards growing station, left is left
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("above the axis, m")
    return figure


def section_errors(comparison: Comparison) -> Figure:
    """Errors of the axis and of the section's size along the tunnel."""
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(11, 4), sharex=True, layout="constrained")
    for axes, names in ((upper, ("lateral", "vertical")), (lower, ("width", "height"))):
        for name, colour in zip(names, (_INK, _ODOMETRY), strict=True):
            axes.plot(comparison.station, 100 * getattr(comparison, name), color=colour, lw=1.2, label=name)
        axes.axhline(0, color="0.6", lw=0.8)
        axes.set_ylabel("error, cm")
        axes.legend(fontsize=8, loc="upper right")
        axes.grid(alpha=0.3)
    lower.set_xlabel("station, m")
    return figure


def drawn_view(tunnel_path: Path, lining: str = "pockets", stretch: float = 20.0) -> Figure:
    """The first metres of the planar tunnel from above: what the LiDAR of the environment sees."""
    with np.load(tunnel_path) as tunnel:
        figure, axes = plt.subplots(figsize=(11, 3), layout="constrained")
        origin, heading = tunnel["centre"][0], tunnel["tangent"][0]
        turn = np.array([heading, [-heading[1], heading[0]]])
        for side in ("left", "right"):
            wall = tunnel[f"{side}_{lining}"][tunnel[f"{side}_station_{lining}"] < stretch]
            axes.plot(*(turn @ (wall - origin).T), color=_INK, lw=1.0)
        axes.plot(*(turn @ (tunnel["centre"][tunnel["station"] < stretch] - origin).T), color=_TRUTH, lw=0.8, ls=":")
        axes.set(xlabel="m", ylabel="m", aspect="equal")
        axes.set_title(f"Walls at LiDAR height, {float(tunnel['lidar_height']):g} m above the sleepers ({lining})")
        axes.grid(alpha=0.3)
        return figure


def scene_points(scene: Path) -> Float[np.ndarray, "p 3"]:
    """The registered cloud of a scene folder, thinned, in the tunnel frame, m."""
    cloud = trimesh.load(scene / "cloud.ply")
    assert isinstance(cloud, trimesh.PointCloud)  # for the type checker; the builder writes no faces
    return np.asarray(cloud.vertices)


def drawn_bore(bore_path: Path, eye: float = 2.0, reach: float = 40.0) -> Figure:
    """The bore in perspective from `eye` metres inside, as its sections every metre: where nothing can be rendered."""
    with np.load(bore_path) as data:
        bore = {name: data[name] for name in data.files}
    start = int(np.searchsorted(bore["station"], eye))
    frame = np.stack([bore["lateral"][start], bore["up"][start], bore["tangent"][start]])
    figure, axes = plt.subplots(figsize=(8, 6), layout="constrained")
    for row in range(start + 4, len(bore["station"]), 4):
        if bore["station"][row] > eye + reach:
            break
        across, along = bore["radius"][row] * np.cos(bore["angle"]), bore["radius"][row] * np.sin(bore["angle"])
        ring = bore["position"][row] + across[:, None] * bore["lateral"][row] + along[:, None] * bore["up"][row]
        left, up, ahead = frame @ (ring - bore["position"][start]).T
        seen = ahead > 0.5
        axes.plot(-left[seen] / ahead[seen], up[seen] / ahead[seen], color=_INK, lw=0.6, alpha=0.8)
    axes.set(xlim=(-1.4, 1.4), ylim=(-1.05, 1.05), aspect="equal")
    axes.set_axis_off()
    return figure
