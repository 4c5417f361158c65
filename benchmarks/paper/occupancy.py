"""Fig. 3: occupied voxels of the bore's shell from three sides, and where scene and held-out cloud differ."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.patches import Patch

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.voxels import EDGE, Occupied, iou, occupied, tolerant
from benchmarks.fidelity.figures.style import AGREE, ONLY_CLOUD, ONLY_MESH
from benchmarks.paper.material import Material
from benchmarks.paper.sheet import PAGE, Drawing

_AXES = ("X: along the path, m", "Y: left, m", "Z: up, m")
_CLASSES = (("both", AGREE), ("scene only", ONLY_MESH), ("held-out cloud only", ONLY_CLOUD))


def draw(material: Material) -> Drawing:
    """X-Y, X-Z and Y-Z sums of the scene's voxels, and the X-Z comparison with the held-out cloud."""
    grids = occupied(material.case)
    low = lowest(material.case, grids)
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
    classes = compared(grids)
    share = _shares(classes)
    _mismatch(figure.add_subplot(layout[2, 0]), classes, low)
    names = [f"{name}: {100 * share[name]:.1f} %" for name, _ in _CLASSES]
    handles = [Patch(color=colour, label=name) for name, (_, colour) in zip(names, _CLASSES, strict=True)]
    legend = figure.add_subplot(layout[2, 1:])
    legend.set_axis_off()
    legend.legend(handles=handles, loc="center left", frameon=False, title="pixels of (b)", alignment="left")
    facts = _facts(grids) | {"edge": EDGE, "pixels": share}
    return Drawing(figure, _caption(facts), _table(grids, low), facts)


def lowest(case: Case, grids: Occupied) -> Float[np.ndarray, "3"]:
    """Lowest corner of the grid: along the held-out sensor's path from where its cloud begins, left and up, m."""
    first = np.argwhere(grids.real).min(axis=0)
    cell = np.floor(returns(case).local.min(axis=0) / EDGE)
    return EDGE * np.array([-first[0], *(cell[1:] - first[1:])])


def compared(grids: Occupied) -> Float[np.ndarray, "i k"]:
    """From the side: 0 where both surfaces are, 1 the scene's alone, 2 the held-out cloud's alone, else no number."""
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
    return [float(low[k] + EDGE * n) for k in (across, upward) for n in (0, shape[k])]


def _shares(classes: Float[np.ndarray, "i k"]) -> dict[str, float]:
    count = max(int(np.isfinite(classes).sum()), 1)
    return {name: float((classes == k).sum() / count) for k, (name, _) in enumerate(_CLASSES)}


def _facts(grids: Occupied) -> dict[str, Any]:
    whole = np.zeros(len(grids.station), int)
    return {
        "iou": iou(grids.real, grids.first),
        "iou_of_two_draws": iou(grids.second, grids.first),
        "f1_one_voxel": float(tolerant(grids, whole)[0]),
        "voxels_scene": int(grids.first.sum()),
        "voxels_cloud": int(grids.real.sum()),
    }


def _table(grids: Occupied, low: np.ndarray) -> dict[str, np.ndarray]:
    """One row a voxel that either surface occupies: its middle, and which of them."""
    index = np.argwhere(grids.real | grids.first)
    middle = np.round(low + EDGE * (index + 0.5), 6)
    at = tuple(index.T)
    columns = dict(zip(("along", "left", "up"), middle.T, strict=True))
    return columns | {"scene": grids.first[at].astype(int), "cloud": grids.real[at].astype(int)}


def _caption(facts: dict[str, Any]) -> str:
    both = facts["pixels"]["both"]
    return (
        f"Occupied voxels of {100 * facts['edge']:.0f} cm. (a) The bore's shell in the scene as the held-out beams see "
        f"it, summed along each axis. (b) From the side, against the held-out cloud: {100 * both:.1f} % of the pixels "
        f"agree. Voxel by voxel the intersection over union is {100 * facts['iou']:.1f} % (two draws of the range "
        f"noise in the same scene: {100 * facts['iou_of_two_draws']:.1f} %), F1 within one voxel "
        f"{100 * facts['f1_one_voxel']:.2f} %."
    )
