"""Figures 1 to 3: recording beside bore, construction pipeline, occupancy."""

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Patch

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.distances import VOXEL_EDGE, Occupied, iou, occupied_voxels, tolerant_f1
from benchmarks.fidelity.derive.surface import surface_caster
from benchmarks.fidelity.figures.sheet import AGREE, BLUE, GREY, INK, ONLY_CLOUD, ONLY_MESH
from benchmarks.paper.camera import Pose
from benchmarks.paper.material import Material
from benchmarks.paper.sheet import PAGE, Drawing

# Figure 1: recording beside bore.
_NEAREST = 0.3  # m; nearer returns are not drawn
_RADIUS = 0.016  # m: radius of a drawn return, never less than a pixel
_LARGEST = 9  # pixels across a drawn return, at most


def draw_bore_view(material: Material) -> Drawing:
    """Draws figure 1: recorded returns by depth on the left, MuJoCo's picture on the right."""
    pose, frame = material.pose, material.frame
    points = _in_camera(pose, frame.points)
    depth = depth_image(pose, points)
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
        "camera": {"at": pose.position.tolist(), "ahead": pose.ahead.tolist(), "fov_vertical": pose.fov},
        "returns": len(frame.points),
        "residual_median": median,
        "residual_within_10cm": share,
    }
    return Drawing(figure, caption, dict(zip(("right", "up", "ahead"), points.T, strict=True)), facts)


def depth_image(pose: Pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "height width"]:
    """Returns the depth of the nearest return in each pixel, m; NaN where there is none.

    Args:
        pose: Camera.
        points: Returns to the right, up and ahead of it, m; each is drawn at its size for its distance.
    """
    image = np.full((pose.height, pose.width), np.inf)
    column = np.round(0.5 * pose.width + pose.focal * points[:, 0] / points[:, 2]).astype(int)
    row = np.round(0.5 * pose.height - pose.focal * points[:, 1] / points[:, 2]).astype(int)
    reach = np.clip(pose.focal * _RADIUS / points[:, 2], 1, _LARGEST // 2).astype(int)
    for down in range(-(_LARGEST // 2), _LARGEST // 2 + 1):
        for across in range(-(_LARGEST // 2), _LARGEST // 2 + 1):
            covers = reach >= max(abs(down), abs(across))
            y, x = row[covers] + down, column[covers] + across
            inside = (y >= 0) & (y < pose.height) & (x >= 0) & (x < pose.width)
            np.minimum.at(image, (y[inside], x[inside]), points[covers][inside, 2])
    return np.where(np.isfinite(image), image, np.nan)


def _in_camera(pose: Pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """Returns the points inside the camera's picture: right, up and ahead of it, m."""
    local = (points - pose.position) @ pose.axes.T
    local = local[local[:, 2] > _NEAREST]
    half = 0.5 * np.array([pose.width, pose.height]) / pose.focal
    return local[(np.abs(local[:, :2] / local[:, 2:]) <= half).all(axis=1)]


def _residual(material: Material) -> Float[np.ndarray, " k"]:
    """Returns range in the scene less recorded range, m, for the frame's beams that meet the scene."""
    frame = material.frame
    beam = frame.points - frame.origin
    reach = np.linalg.norm(beam, axis=1)
    cast, _ = surface_caster(material.case).first(frame.origin, beam / np.maximum(reach, 1e-9)[:, None])
    return (cast - reach)[np.isfinite(cast)]


# Figure 2: construction pipeline.
_SLICE = 0.15  # m either side of a section
_HISTOGRAM = 0.10  # m, largest error in the histogram
_STRETCH = 4.0  # m either side of the section in the view from above
_WALL = 0.25  # m left out beside the walls, whose height would use up the colour range
_KNEE = -1.3  # m above the axis: track and floor lie below
_HEIGHT = 1.45  # in, height of the figure
_TOP, _BOTTOM, _GAP, _EDGE = 0.87, 0.32, 0.033, 0.008  # shares of the figure


def draw_pipeline(material: Material) -> Drawing:
    """Draws figure 2: six stages from the recording to the validated scene, with arrows between them."""
    stages = _stages(material)
    figure = plt.figure(figsize=(PAGE, _HEIGHT))
    width = (1.0 - 2 * _EDGE - (len(stages) - 1) * _GAP) / len(stages)
    for k, (title, paint, lines) in enumerate(stages):
        left = _EDGE + k * (width + _GAP)
        axes = figure.add_axes((left, _BOTTOM, width, _TOP - _BOTTOM))
        paint(material, axes)
        axes.set(xticks=[], yticks=[])
        figure.text(left + 0.5 * width, _TOP + 0.03, title, ha="center", va="bottom", weight="bold", fontsize=7.5)
        figure.text(left + 0.5 * width, _BOTTOM - 0.03, "\n".join(lines), ha="center", va="top", fontsize=6.5)
        if k:
            _arrow(figure, left - _GAP, left)
    rows = [(title, line.replace("$\\times$", "x")) for title, _, lines in stages for line in lines]
    columns = {"stage": np.array([row[0] for row in rows]), "what": np.array([row[1] for row in rows])}
    caption = (
        "Construction pipeline: from the recording to the validated MJCF scene. The last stage compares the scene with "
        "a LiDAR that the builder never read."
    )
    error = np.abs(material.residual)
    facts = {"beams": len(error), "median": float(np.median(error)), "within_10cm": float(np.mean(error < _HISTOGRAM))}
    return Drawing(figure, caption, columns, {"held_out": facts})


def _stages(material: Material) -> tuple[tuple[str, Callable[[Material, Any], None], list[str]], ...]:
    """Returns title, picture and text lines of each stage, all from the manifest and the held-out beams."""
    facts, bore, count = (material.manifest[name] for name in ("detected", "bore", "count"))
    error = np.abs(material.residual)
    poses = str(facts["length_fixed_by"])
    size = f"{bore['width_mean']:.2f} $\\times$ {bore['height_mean']:.2f} m"
    return (
        ("recording", _scan, [f"{facts['scans']:,} scans", f"{facts['returns'] / 1e6:.1f} M returns"]),
        ("cloud", _plan, [f"{facts['points'] / 1e6:.2f} M voxels", f"by {poses}"]),
        ("bore", _section, [f"{bore['length']:.1f} m", size]),
        ("lining, track", _wall, [f"{count['pockets']:,} pockets", f"{count['sleepers']:,} sleepers"]),
        ("MuJoCo scene", _view, [f"{count['lining_faces'] / 1e3:.0f} k faces", "MJCF, MJX, JAX"]),
        (
            "held-out LiDAR",
            _errors,
            [f"median {100 * np.median(error):.1f} cm", f"{100 * np.mean(error < _HISTOGRAM):.1f} % in 10 cm"],
        ),
    )


def _scan(material: Material, axes: Any) -> None:
    """Draws one raw scan from the side."""
    frame, pose = material.frame, material.pose
    local = (frame.points[frame.single] - pose.position) @ pose.axes.T
    local = local[local[:, 2] < 30.0]
    axes.scatter(local[:, 2], local[:, 1], c=local[:, 2], cmap="viridis_r", s=0.4, lw=0.0, rasterized=True)
    axes.set(xlim=(-1.0, 30.0), ylim=(-8.0, 10.0))


def _plan(material: Material, axes: Any) -> None:
    """Draws the cloud of floor and track from above, coloured by height."""
    bore, row = material.case.candidate.bore, material.row
    offset = material.cloud - bore.position[row]
    along, left, up = (offset @ axis[row] for axis in (bore.tangent, bore.lateral, bore.up))
    shown = (np.abs(along) < _STRETCH) & (np.abs(left) < 0.5 * bore.width[row] - _WALL) & (up < _KNEE)
    order = np.argsort(up[shown])
    along, left, up = (values[shown][order] for values in (along, left, up))
    low, high = np.percentile(up, (1, 99))
    axes.scatter(along, left, c=up, cmap="cividis", s=0.8, lw=0.0, vmin=low, vmax=high, rasterized=True)
    axes.set_aspect("equal", adjustable="datalim")


def _section(material: Material, axes: Any) -> None:
    """Draws the section at the frame's place over the cloud around it."""
    bore, row = material.case.candidate.bore, material.row
    offset = material.cloud - bore.position[row]
    near = offset[np.abs(offset @ bore.tangent[row]) < _SLICE]
    near = near[np.linalg.norm(near, axis=1) < 2.0 * bore.radius[row].max()]
    axes.plot(near @ -bore.lateral[row], near @ bore.up[row], ".", ms=0.8, color=GREY, rasterized=True)
    angle, radius = np.append(bore.angle, bore.angle[0]), np.append(bore.radius[row], bore.radius[row][0])
    axes.plot(-radius * np.cos(angle), radius * np.sin(angle), color=BLUE, lw=1.0)
    axes.set_aspect("equal", adjustable="datalim")


def _wall(material: Material, axes: Any) -> None:
    axes.imshow(material.wall, aspect="auto")


def _view(material: Material, axes: Any) -> None:
    view = material.view
    cut = (view.shape[1] - view.shape[0]) // 2
    axes.imshow(view[:, cut : view.shape[1] - cut], aspect="auto")


def _errors(material: Material, axes: Any) -> None:
    """Draws the histogram of ranges in the scene less those of the held-out LiDAR."""
    axes.hist(100.0 * material.residual, np.linspace(-100 * _HISTOGRAM, 100 * _HISTOGRAM, 41), color=BLUE)
    axes.axvline(0.0, color=INK, lw=0.6)
    axes.set_xlim(-100 * _HISTOGRAM, 100 * _HISTOGRAM)
    for at, place in ((0.03, "left"), (0.97, "right")):
        text = "$-$10 cm" if place == "left" else "10 cm"
        axes.text(at, 0.97, text, transform=axes.transAxes, ha=place, va="top", fontsize=5.5)


def _arrow(figure: Figure, start: float, end: float) -> None:
    middle = 0.5 * (_TOP + _BOTTOM)
    figure.add_artist(
        FancyArrowPatch((start, middle), (end, middle), transform=figure.transFigure, arrowstyle="-|>",
                        mutation_scale=8, color=INK, lw=0.9, shrinkA=1.5, shrinkB=1.5)
    )  # fmt: skip


# Figure 3: occupied voxels of the bore's shell from three sides, and where scene and held-out cloud differ.
_AXES = ("X: along the path, m", "Y: left, m", "Z: up, m")
_CLASSES = (("both", AGREE), ("scene only", ONLY_MESH), ("held-out cloud only", ONLY_CLOUD))


def draw_occupancy(material: Material) -> Drawing:
    """Draws figure 3: X-Y, X-Z and Y-Z sums of the scene's voxels, and X-Z against the held-out cloud."""
    grids = occupied_voxels(material.case)
    low = grid_corner(material.case, grids)
    figure = plt.figure(figsize=(PAGE, 3.3), layout="constrained")
    layout = figure.add_gridspec(3, 3, width_ratios=(4.2, 1.45, 0.08))
    norm = LogNorm(1, max(2, max(int(grids.first.sum(axis=k).max()) for k in range(3))))
    places = ((layout[0, 0], 2), (layout[1, 0], 1), (layout[0:2, 1], 0))
    for place, along in places:
        axes = figure.add_subplot(place)
        shown = _projection(axes, grids.first, along, low, norm)
        axes.set_title(f"(a) {'-'.join(axis for k, axis in enumerate('XYZ') if k != along)}", loc="left")
    bar = figure.colorbar(shown, cax=figure.add_subplot(layout[0:2, 2]))
    bar.set_label("voxels, summed")
    classes = classify_side_view(grids)
    share = _shares(classes)
    _mismatch(figure.add_subplot(layout[2, 0]), classes, low)
    names = [f"{name}: {100 * share[name]:.1f} %" for name, _ in _CLASSES]
    handles = [Patch(color=colour, label=name) for name, (_, colour) in zip(names, _CLASSES, strict=True)]
    legend = figure.add_subplot(layout[2, 1:])
    legend.set_axis_off()
    legend.legend(handles=handles, loc="center left", frameon=False, title="pixels of (b)", alignment="left")
    facts = _facts(grids) | {"edge": VOXEL_EDGE, "pixels": share}
    return Drawing(figure, _caption(facts), _table(grids, low), facts)


def grid_corner(case: Case, grids: Occupied) -> Float[np.ndarray, "3"]:
    """Returns the lowest corner of the grid: along the held-out path from the cloud's start, left and up, m."""
    first = np.argwhere(grids.real).min(axis=0)
    cell = np.floor(returns(case).local.min(axis=0) / VOXEL_EDGE)
    return VOXEL_EDGE * np.array([-first[0], *(cell[1:] - first[1:])])


def classify_side_view(grids: Occupied) -> Float[np.ndarray, "i k"]:
    """Returns from the side 0 where both surfaces are, 1 for the scene's alone, 2 for the cloud's alone, else NaN."""
    real, scene = grids.real.any(axis=1), grids.first.any(axis=1)
    return np.where(real & scene, 0.0, np.where(scene, 1.0, np.where(real, 2.0, np.nan)))


def _projection(axes: Any, grid: Bool[np.ndarray, "i j k"], along: int, low: np.ndarray, norm: LogNorm) -> Any:
    across, upward = (k for k in range(3) if k != along)
    total = grid.sum(axis=along).astype(float)
    shown = axes.imshow(
        np.where(total > 0, total, np.nan).T, extent=_extent(low, grid.shape, across, upward), norm=norm,
        origin="lower", aspect="equal" if along == 0 else "auto", cmap="viridis", interpolation="nearest",
    )  # fmt: skip
    axes.set(xlabel=_AXES[across] if along == 0 else "", ylabel=_AXES[upward])
    return shown


def _mismatch(axes: Any, classes: Float[np.ndarray, "i k"], low: np.ndarray) -> None:
    shape = (classes.shape[0], 0, classes.shape[1])
    axes.imshow(
        classes.T, extent=_extent(low, shape, 0, 2), cmap=ListedColormap([colour for _, colour in _CLASSES]),
        vmin=0, vmax=2, origin="lower", aspect="auto", interpolation="nearest",
    )  # fmt: skip
    axes.set(xlabel=_AXES[0], ylabel=_AXES[2])
    axes.set_title("(b) X-Z, scene against held-out cloud", loc="left")


def _extent(low: np.ndarray, shape: tuple[int, ...], across: int, upward: int) -> list[float]:
    return [float(low[k] + VOXEL_EDGE * n) for k in (across, upward) for n in (0, shape[k])]


def _shares(classes: Float[np.ndarray, "i k"]) -> dict[str, float]:
    count = max(int(np.isfinite(classes).sum()), 1)
    return {name: float((classes == k).sum() / count) for k, (name, _) in enumerate(_CLASSES)}


def _facts(grids: Occupied) -> dict[str, Any]:
    whole = np.zeros(len(grids.station), int)
    return {
        "iou": iou(grids.real, grids.first),
        "iou_of_two_draws": iou(grids.points[2] > 0, grids.first),
        "f1_one_voxel": float(tolerant_f1(grids, whole)[0]),
        "voxels_scene": int(grids.first.sum()),
        "voxels_cloud": int(grids.real.sum()),
    }


def _table(grids: Occupied, low: np.ndarray) -> dict[str, np.ndarray]:
    """Returns one row for each occupied voxel: its middle, m, and which surfaces occupy it."""
    index = np.argwhere(grids.real | grids.first)
    middle = np.round(low + VOXEL_EDGE * (index + 0.5), 6)
    cells = tuple(index.T)
    columns = dict(zip(("along", "left", "up"), middle.T, strict=True))
    return columns | {"scene": grids.first[cells].astype(int), "cloud": grids.real[cells].astype(int)}


def _caption(facts: dict[str, Any]) -> str:
    both = facts["pixels"]["both"]
    return (
        f"Occupied voxels of {100 * facts['edge']:.0f} cm. (a) The bore's shell in the scene as the held-out beams see "
        f"it, summed along each axis. (b) From the side, against the held-out cloud: {100 * both:.1f} % of the pixels "
        f"agree. Voxel by voxel the intersection over union is {100 * facts['iou']:.1f} % (two draws of the range "
        f"noise in the same scene: {100 * facts['iou_of_two_draws']:.1f} %), F1 within one voxel "
        f"{100 * facts['f1_one_voxel']:.2f} %."
    )
