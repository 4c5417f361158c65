"""Free space at the sensor's height, and what room there is along the tunnel."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from scipy.ndimage import distance_transform_edt

from benchmarks.fidelity.derive.freeplane import plane
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import AGREE, BLUE, INK, ONLY_CLOUD, ONLY_MESH


def plan(sheet: Sheet) -> Drawn | None:
    """F11: free cells of both, the way of most clearance, clearance along it."""
    if sheet.case.hold is None and sheet.case.truth is None:
        return None
    found = plane(sheet.case)
    lattice, edge = found.lattice, found.lattice.edge
    classes = np.where(
        found.judged & found.reference, 0.0, np.where(found.judged, 1.0, np.where(found.reference, 2.0, np.nan))
    )
    classes = np.where(found.known, classes, np.nan)
    left = lattice.low[1] + edge * (np.arange(lattice.shape[1]) + 0.5)
    figure, (map_axis, room) = plt.subplots(2, 1, figsize=(12, 5), layout="constrained", sharex=True)
    extent = [
        lattice.low[0],
        lattice.low[0] + edge * lattice.shape[0],
        lattice.low[1],
        lattice.low[1] + edge * lattice.shape[1],
    ]
    map_axis.imshow(
        classes.T,
        origin="lower",
        extent=extent,
        aspect="auto",
        cmap=ListedColormap([AGREE, ONLY_MESH, ONLY_CLOUD]),
        vmin=0,
        vmax=2,
        alpha=0.55,
        interpolation="nearest",
    )
    for free, colour, label in ((found.reference, INK, "reference"), (found.judged, BLUE, "reconstruction")):
        clearance = distance_transform_edt(np.pad(free, ((0, 0), (1, 1))))[:, 1:-1] * edge
        map_axis.plot(found.station, left[np.argmax(clearance, axis=1)], color=colour, lw=1)
        room.plot(found.station, clearance.max(axis=1), color=colour, lw=1.2, label=label)
    names = (
        ("free in both", AGREE),
        ("free in the reconstruction only", ONLY_MESH),
        ("free in the reference only", ONLY_CLOUD),
    )
    map_axis.legend(
        handles=[Patch(color=c, alpha=0.55, label=n) for n, c in names],
        loc="upper center",
        bbox_to_anchor=(0.5, 1.2),
        ncol=3,
        frameon=False,
    )
    map_axis.set(ylabel="left, m")
    room.set(xlabel="station, m", ylabel="largest clearance, m", ylim=(0, 1.1 * room.dataLim.y1))
    room.legend(frameon=False, loc="lower right")
    return (
        figure,
        f"Free cells of {edge * 100:.0f} cm at sensor height, places of most clearance (lines), and that clearance."
        + sheet.note(int(found.known.sum())),
    )
