"""The errors along the way over time, as a picture for the page: inline SVG with axes and units."""

import numpy as np
from jaxtyping import Float

from subterra_jax.viewer.episode import SIGMAS, Drawn

TRUTH, ODOMETRY, ESTIMATE = (64, 156, 255), (255, 120, 60), (190, 110, 255)
_SIZE, _LEFT, _BELOW = (320, 130), 44, 30  # pixels
_POINTS = 300  # of a curve


def rgb(colour: tuple[int, int, int], opacity: float = 1.0) -> str:
    """Return a colour, 0 to 255, for a page."""
    return f"rgba{(*colour, opacity)}"


def error_chart(drawn: Drawn) -> str:
    """Return the errors of odometer and estimate with its band of two standard deviations, over time."""
    rows = np.unique(np.linspace(0, len(drawn) - 1, _POINTS).astype(int))
    station, sigma = drawn.estimate[rows].T
    error = station - np.asarray(drawn.trace.state.station, np.float64)[rows]
    edge = rgb(ESTIMATE, 0.45)
    curves = [(rgb(ODOMETRY), drawn.odometer_error[rows]), (rgb(ESTIMATE), error)]
    curves += [(edge, error + side * SIGMAS * sigma) for side in (-1.0, 1.0)]
    return _draw(rows * drawn.trace.period, curves)


def _draw(time: Float[np.ndarray, "n"], curves: list[tuple[str, np.ndarray]]) -> str:
    """Return curves of a colour each, without their values that are not finite."""
    width, height = _SIZE
    known = np.concatenate([values[np.isfinite(values)] for _, values in curves])
    low, high, last = min(float(known.min()), -0.1), max(float(known.max()), 0.1), max(float(time[-1]), 0.1)

    def place(at: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"]) -> str:
        x, y = _LEFT + at / last * (width - _LEFT - 8), 16 + (high - values) / (high - low) * (height - 16 - _BELOW)
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))

    def line(points: str, colour: str) -> str:
        return f"<polyline points='{points}' fill='none' stroke='{colour}' stroke-width='1.5'/>"

    def word(x: float, y: float, text: str, anchor: str) -> str:
        return f"<text x='{x}' y='{y}' fill='#ddd' font-size='11' text-anchor='{anchor}'>{text}</text>"

    def level(value: float) -> str:
        return line(place(np.array([0.0, last]), np.full(2, value)), "#555")

    parts = [level(value) for value in (low, 0.0, high)]
    for colour, values in curves:
        there = np.isfinite(values)
        parts.append(line(place(time[there], values[there]), colour))
    base = height - _BELOW
    parts += [
        word(_LEFT, 10, "error along the way, m", "start"),
        word(_LEFT - 4, 20, f"{high:.1f}", "end"),
        word(_LEFT - 4, base + 4, f"{low:.1f}", "end"),
        word(_LEFT, base + 16, "0", "middle"),
        word(width - 8, base + 16, f"{last:.0f}", "end"),
        word((_LEFT + width) / 2, base + 28, "time, s", "middle"),
    ]
    return f"<br><svg width='{width}' height='{height}'>{''.join(parts)}</svg>"
