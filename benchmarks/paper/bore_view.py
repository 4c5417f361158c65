"""Fig. 1: a frame of the recording beside the reconstructed bore, from the same place."""

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.colors import LogNorm

from benchmarks.fidelity.derive.surface import intersector
from benchmarks.paper.camera import Pose
from benchmarks.paper.material import Material
from benchmarks.paper.sheet import PAGE, Drawing

_NEAREST = 0.3  # m
_RADIUS = 0.016  # m: of a return as it is drawn, never less than a pixel
_MOST = 9  # pixels across


def draw(material: Material) -> Drawing:
    """Recorded returns by their depth on the left, MuJoCo's picture on the right."""
    pose, frame = material.pose, material.frame
    seen = _in_camera(pose, frame.points)
    depth = depth_image(pose, seen)
    figure, (left, right) = plt.subplots(1, 2, figsize=(PAGE, 2.72), layout="constrained")
    shown = left.imshow(depth, cmap="viridis_r", norm=LogNorm(2.0, 40.0), interpolation="nearest")
    kind = "simulated recording" if material.simulated else "recording"
    left.set_title(f"(a) {kind}, {frame.duration:g} s of {frame.topic}")
    right.imshow(material.view)
    right.set_title("(b) reconstructed bore in MuJoCo, same pose")
    for axes in (left, right):
        axes.set(xticks=[], yticks=[])
    bar = figure.colorbar(shown, ax=left, location="left", shrink=0.9, pad=0.02, ticks=(2, 5, 10, 20, 40), extend="max")
    bar.set_label("depth, m")
    bar.ax.minorticks_off()
    bar.ax.set_yticklabels(("2", "5", "10", "20", "40"))
    error = _residual(material)
    median, share = float(np.median(np.abs(error))), float(np.mean(np.abs(error) < 0.10))
    caption = (
        f"Recorded and reconstructed. {frame.duration:g} s of a {kind}, coloured by depth (a), and the MuJoCo "
        f"scene rendered from the same pose (b). Along the recorded beams the scene is {100 * median:.1f} cm from the "
        f"returns (median; {100 * share:.1f} % within 10 cm)."
    )
    facts = {
        "camera": {"at": pose.at.tolist(), "ahead": pose.ahead.tolist(), "fov_vertical": pose.fov},
        "returns": len(frame.points),
        "residual_median": median,
        "residual_within_10cm": share,
    }
    return Drawing(figure, caption, dict(zip(("right", "up", "ahead"), seen.T, strict=True)), facts)


def depth_image(pose: Pose, seen: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "height width"]:
    """Depth of the nearest return in each pixel, m; not a number where there is none.

    Args:
        pose: The camera.
        seen: Returns right, up and ahead of it, m; each covers its size as far as it is away.
    """
    image = np.full((pose.height, pose.width), np.inf)
    column = np.round(0.5 * pose.width + pose.focal * seen[:, 0] / seen[:, 2]).astype(int)
    row = np.round(0.5 * pose.height - pose.focal * seen[:, 1] / seen[:, 2]).astype(int)
    reach = np.clip(pose.focal * _RADIUS / seen[:, 2], 1, _MOST // 2).astype(int)
    for down in range(-(_MOST // 2), _MOST // 2 + 1):
        for across in range(-(_MOST // 2), _MOST // 2 + 1):
            covers = reach >= max(abs(down), abs(across))
            y, x = row[covers] + down, column[covers] + across
            inside = (y >= 0) & (y < pose.height) & (x >= 0) & (x < pose.width)
            np.minimum.at(image, (y[inside], x[inside]), seen[covers][inside, 2])
    return np.where(np.isfinite(image), image, np.nan)


def _in_camera(pose: Pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """The points before the camera and in its picture: right, up and ahead of it, m."""
    local = (points - pose.at) @ pose.axes.T
    local = local[local[:, 2] > _NEAREST]
    half = 0.5 * np.array([pose.width, pose.height]) / pose.focal
    return local[(np.abs(local[:, :2] / local[:, 2:]) <= half).all(axis=1)]


def _residual(material: Material) -> Float[np.ndarray, " k"]:
    """Range in the scene less range recorded, m, of the frame's beams that meet the scene."""
    frame = material.frame
    beam = frame.points - frame.origin
    reach = np.linalg.norm(beam, axis=1)
    cast, _ = intersector(material.case).first(frame.origin, beam / np.maximum(reach, 1e-9)[:, None])
    return (cast - reach)[np.isfinite(cast)]
