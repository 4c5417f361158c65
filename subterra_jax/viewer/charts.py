"""Coverage, reward and errors along the axis over time."""

import numpy as np
import viser
from viser import uplot

from subterra_jax.viewer.frames import SIGMAS, Film
from subterra_jax.viewer.stage import ESTIMATE, ODOMETRY, TRUTH

_POINTS = 300  # of a curve
_RETURN = (60, 180, 110)


def _line(label: str, colour: tuple[int, int, int]) -> uplot.Series:
    return uplot.Series(label=label, stroke=f"rgb{colour}", width=2)


def _edge(label: str) -> uplot.Series:
    return uplot.Series(label=label, stroke=f"rgba{(*ESTIMATE, 0.45)}", width=1)


_ERROR_TITLE = "error along the way, m"
_TIME = uplot.Series(label="s")
_ERRORS = (_line("odometry", ODOMETRY), _line("estimate", ESTIMATE), _edge("- 2 sd"), _edge("+ 2 sd"))


def progress_series(film: Film) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (s), coverage (%) and reward so far."""
    recording = film.recording
    time = np.arange(len(film)) * recording.period
    return time, 100.0 * recording.coverage.astype(float), np.cumsum(recording.reward.astype(float))


def error_series(film: Film) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time (s), error of the odometer's distance (m), of the estimated station (m), and that less and plus 2σ."""
    recording = film.recording
    time = np.arange(len(film)) * recording.period
    step = np.linalg.norm(np.diff(recording.position.astype(float), axis=0), axis=1)
    odometer = recording.odometry[:, 0] - np.concatenate([[0.0], np.cumsum(step)])
    error = recording.estimate[:, 0].astype(float) - recording.station
    spread = SIGMAS * recording.estimate[:, 1].astype(float)
    return time, odometer, error, error - spread, error + spread


class Charts:
    """The three charts of the panel.

    Args:
        server: Where they are drawn, within whatever folder is open.
    """

    def __init__(self, server: viser.ViserServer):
        # Two, of which one is shown: a chart whose number of curves changes loses its scales.
        self._odometry = _chart(server, _ERROR_TITLE, _ERRORS[:1])
        self._estimate = _chart(server, _ERROR_TITLE, _ERRORS, visible=False)
        self._coverage = _chart(server, "coverage, %", (_line("coverage", TRUTH),))
        self._reward = _chart(server, "reward so far", (_line("reward", _RETURN),))

    def show(self, film: Film, row: int) -> None:
        """The curves from the start to a row."""
        rows = _thinned(row)
        time, coverage, reward = (values[rows] for values in progress_series(film))
        self._coverage.data, self._reward.data = (time, coverage), (time, reward)
        curves = [values[rows] for values in error_series(film)]
        # Nobody has estimated anything before the first step.
        known = row > 0 and bool(np.isfinite(curves[2][1:]).all())
        self._odometry.visible, self._estimate.visible = not known, known
        if not known:
            self._odometry.data = tuple(curves[:2])
            return
        for curve in curves[2:]:
            curve[0] = curve[1]
        self._estimate.data = tuple(curves)


def _thinned(row: int) -> np.ndarray:
    """Rows from 0 to `row`, both among them, `_POINTS` at most or so."""
    rows = np.arange(0, row + 1, max(1, row // _POINTS))
    return rows if rows[-1] == row else np.append(rows, row)


def _chart(
    server: viser.ViserServer, title: str, lines: tuple[uplot.Series, ...], *, visible: bool = True
) -> viser.GuiUplotHandle:
    """A chart of lines over time, empty at first."""
    return server.gui.add_uplot(
        (np.zeros(1),) * (1 + len(lines)),
        (_TIME, *lines),
        title=title,
        scales={"x": uplot.Scale(time=False)},
        legend=uplot.Legend(show=False),
        height=140,
        visible=visible,
    )
