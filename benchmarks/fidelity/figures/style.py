"""Colours that colour-blind readers can tell apart (after Okabe and Ito), and what several figures share."""

import numpy as np
from jaxtyping import Float
from matplotlib.colors import LinearSegmentedColormap

INK, BLUE, ORANGE, GREEN, RED, GREY = "#1b1b1b", "#0072b2", "#e69f00", "#009e73", "#d55e00", "#999999"
AGREE, ONLY_MESH, ONLY_CLOUD = "#009e73", "#d55e00", "#0072b2"  # the paper's green, red and blue, told apart by anybody
DIVERGING = LinearSegmentedColormap.from_list("error", ["#0072b2", "#f7f7f7", "#d55e00"])


def binned(
    station: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], width: float, statistic
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    """Middle of each bin along the tunnel and a statistic of the values in it; bins of fewer than 5 are left out."""
    number = np.floor(station / width).astype(int)
    order = np.argsort(number, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
    kept = [group for group in groups if len(group) >= 5]
    middle = np.array([(number[group[0]] + 0.5) * width for group in kept])
    return middle, np.array([statistic(values[group]) for group in kept])
