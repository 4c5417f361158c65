"""Controls, status text and charts beside the scene."""

import dataclasses
from typing import Any

import numpy as np
import viser
from viser import uplot

from subterra_jax.viewer import browsers
from subterra_jax.viewer.config import LININGS
from subterra_jax.viewer.geometry import SIGMAS, EpisodeGeometry
from subterra_jax.viewer.recording import Recording
from subterra_jax.viewer.scene import ESTIMATE, ODOMETRY, TRUTH


def status_text(recording: Recording, row: int, *, finished: bool, note: str = "") -> str:
    """Return task, driver, tunnel and state at a row, as Markdown; `note` is a caveat about the picture."""
    task = recording.task.removeprefix("Subterra/").removesuffix("-v1")
    lines = [
        f"**{task}** · {recording.agent} · seed {int(recording.seed)}  ",
        f"{recording.tunnel}, {recording.lining}, {recording.length:.0f} m  ",
        *([f"<small>{note}</small>"] if note else []),
        "",
        f"station **{recording.station[row]:.1f} m**{_goal(recording)} · {recording.command[row, 0]:.1f} m/s  ",
        _errors(recording, row),
        "",
        _outcome(recording, row, finished),
    ]
    return "\n".join(lines)


def _goal(recording: Recording) -> str:
    return f" of {recording.goal:.1f} m" if np.isfinite(recording.goal) else ""


def _errors(recording: Recording, row: int) -> str:
    moved = np.linalg.norm(np.diff(recording.position[: row + 1].astype(float), axis=0), axis=1).sum()
    odometry = f"error of odometry {recording.odometry[row, 0] - moved:+.2f} m"
    station, sigma = recording.estimate[row]
    if not np.isfinite(station):
        return odometry
    return f"{odometry}, of estimate {station - recording.station[row]:+.2f} ± {sigma:.2f} m"


def _outcome(recording: Recording, row: int, finished: bool) -> str:
    if not finished:
        return f"*driving, {len(recording) - 1} steps so far*"
    if row < len(recording) - 1:
        return f"{row * recording.period:.1f} s of {recording.duration:.1f} s"
    result = "success" if recording.success else "contact" if recording.contact else "no success"
    return f"**{result}** after {recording.duration:.1f} s"


_POINTS = 300  # of a curve
_CHART_HEIGHT = 88  # pixels: three charts below the controls fit a screen of 900
_AXES = (uplot.Axis(size=26), uplot.Axis(space=16, size=50))  # pixels: so low, and yet two numbers or more at the side
_PADDING = (9, 10, 0, 0)  # pixels: half a number above the curves
_RETURN = (60, 180, 110)


def _line(label: str, colour: tuple[int, int, int]) -> uplot.Series:
    return uplot.Series(label=label, stroke=f"rgb{colour}", width=2)


def _edge(label: str) -> uplot.Series:
    return uplot.Series(label=label, stroke=f"rgba{(*ESTIMATE, 0.45)}", width=1)


_ERROR_TITLE = "error along the way, m"
_TIME = uplot.Series(label="s")
_ERRORS = (_line("odometry", ODOMETRY), _line("estimate", ESTIMATE), _edge("- 2 sd"), _edge("+ 2 sd"))


def progress_series(episode: EpisodeGeometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time (s), coverage (%) and reward so far."""
    recording = episode.recording
    time = np.arange(len(episode)) * recording.period
    return time, 100.0 * recording.coverage.astype(float), np.cumsum(recording.reward.astype(float))


def error_series(episode: EpisodeGeometry) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return time (s), errors of odometer and estimated station (m), and the latter minus and plus 2σ (m)."""
    recording = episode.recording
    time = np.arange(len(episode)) * recording.period
    step = np.linalg.norm(np.diff(recording.position.astype(float), axis=0), axis=1)
    odometer = recording.odometry[:, 0] - np.concatenate([[0.0], np.cumsum(step)])
    error = recording.estimate[:, 0].astype(float) - recording.station
    spread = SIGMAS * recording.estimate[:, 1].astype(float)
    return time, odometer, error, error - spread, error + spread


class Charts:
    """Charts of the errors, coverage and reward over time.

    Args:
        server: Server of the page, with the tab of the charts open.
    """

    def __init__(self, server: viser.ViserServer):
        # One of the first two is shown: a chart whose number of curves changes loses its scales.
        self._odometry = _chart(server, _ERROR_TITLE, _ERRORS[:1])
        self._estimate = _chart(server, _ERROR_TITLE, _ERRORS, visible=False)
        self._coverage = _chart(server, "coverage, %", (_line("coverage", TRUTH),))
        self._reward = _chart(server, "reward so far", (_line("reward", _RETURN),))

    def show(self, episode: EpisodeGeometry, row: int) -> None:
        rows = _sample_rows(row)
        time, coverage, reward = (values[rows] for values in progress_series(episode))
        self._coverage.data, self._reward.data = (time, coverage), (time, reward)
        curves = [values[rows] for values in error_series(episode)]
        # There is no estimate before the first step.
        known = row > 0 and bool(np.isfinite(curves[2][1:]).all())
        self._odometry.visible, self._estimate.visible = not known, known
        if not known:
            self._odometry.data = tuple(curves[:2])
            return
        for curve in curves[2:]:
            curve[0] = curve[1]
        self._estimate.data = tuple(curves)


def _sample_rows(row: int) -> np.ndarray:
    """Return about `_POINTS` rows from 0 to `row`, both included."""
    rows = np.arange(0, row + 1, max(1, row // _POINTS))
    return rows if rows[-1] == row else np.append(rows, row)


def _chart(
    server: viser.ViserServer, title: str, lines: tuple[uplot.Series, ...], *, visible: bool = True
) -> viser.GuiUplotHandle:
    return server.gui.add_uplot(
        (np.zeros(1),) * (1 + len(lines)),
        (_TIME, *lines),
        title=title,
        scales={"x": uplot.Scale(time=False)},
        axes=_AXES,
        padding=_PADDING,
        legend=uplot.Legend(show=False),
        height=_CHART_HEIGHT,
        visible=visible,
    )


SPEEDS = ("0.5 x", "1 x", "2 x", "5 x", "10 x", "25 x")
PARTS = ("lining", "track", "beams", "truth", "odometry", "estimate")
NO_RECORDING = "none yet"
_HIT, _GATE = (224, 169, 46), (60, 200, 120)


def legend(recording: Recording | None) -> str:
    """Return the legend as HTML: what an episode shows, and no more; everything before the first episode."""
    estimates = recording is None or bool(np.isfinite(recording.estimate[:, 0]).any())
    goal = recording is None or bool(np.isfinite(recording.goal))
    names = [("truth", TRUTH), ("odometry", ODOMETRY), ("LiDAR", _HIT)]
    names += [("estimate ± 2 sd", ESTIMATE)] * estimates + [("goal", _GATE)] * goal
    words = " · ".join(f"<b style='color:rgb{colour}'>{name}</b>" for name, colour in names)
    return f"<div style='padding:0 0.75em;font-size:0.8em;line-height:1.4'>{words}</div>"


@dataclasses.dataclass(frozen=True)
class Choice:
    """An episode to drive."""

    tunnel: str  # title of the tunnel
    lining: str  # variant of its walls
    task: str  # id of the task
    agent: str  # name of the driver
    seed: int  # seed of the episode


class Panel:
    """The controls, with the names to choose from; the session attaches their effects."""

    def __init__(
        self,
        server: viser.ViserServer,
        first: Choice,
        tunnels: tuple[str, ...],
        tasks: tuple[str, ...],
        agents: tuple[str, ...],
        recordings: tuple[str, ...],
    ):
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label("Subterra")
        self.status = gui.add_markdown("")
        self._legend = gui.add_html(legend(None))
        self.play = gui.add_button("Play")
        self.time = gui.add_slider("time, s", min=0.0, max=1.0, step=0.1, initial_value=0.0)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="2 x")
        self.camera = gui.add_dropdown("camera", browsers.MODES, initial_value=browsers.CHASE)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Charts"):
            self.charts = Charts(server)
        with tabs.add_tab("Episode"):
            self.tunnel = gui.add_dropdown("tunnel", tunnels, initial_value=first.tunnel)
            self.lining = gui.add_dropdown("lining", LININGS, initial_value=first.lining)
            self.task = gui.add_dropdown("task", tasks, initial_value=first.task)
            self.agent = gui.add_dropdown("driver", agents, initial_value=first.agent)
            self.seed = gui.add_number("seed", initial_value=first.seed, min=0, max=2**31 - 1, step=1)
            self.drive = gui.add_button("Drive")
        with tabs.add_tab("Show"):
            self.show = {part: gui.add_checkbox(part, True) for part in PARTS}
            self.cutaway = gui.add_checkbox("see through walls", True)
        with tabs.add_tab("Files"):
            self.save = gui.add_button("Save episode")
            self.picture = gui.add_button("Save picture")
            self.recorded = gui.add_dropdown("recorded", recordings or (NO_RECORDING,))
            self.replay = gui.add_button("Replay")

    @property
    def choice(self) -> Choice:
        return Choice(self.tunnel.value, self.lining.value, self.task.value, self.agent.value, int(self.seed.value))

    def choose(self, choice: Choice) -> None:
        set_value(self.tunnel, choice.tunnel)
        set_value(self.lining, choice.lining)
        for control, value in ((self.task, choice.task), (self.agent, choice.agent)):
            if value in control.options:
                set_value(control, value)
        set_value(self.seed, choice.seed)

    def show_legend(self, recording: Recording) -> None:
        if (text := legend(recording)) != self._legend.content:
            self._legend.content = text

    def list_recordings(self, names: tuple[str, ...], chosen: str) -> None:
        self.recorded.options = names or (NO_RECORDING,)
        set_value(self.recorded, chosen)

    def speed_factor(self) -> float:
        return float(self.speed.value.split()[0])


def set_value(control: Any, value: Any) -> None:
    """Set a control; mypy takes the values of viser's controls for read-only."""
    control.value = value
