"""The controls beside the scene."""

import dataclasses
from typing import Any

import viser

from subterra_jax.viewer import cameras
from subterra_jax.viewer.charts import Charts
from subterra_jax.viewer.config import LININGS

SPEEDS = ("0.5 x", "1 x", "2 x", "5 x", "10 x", "25 x")
PARTS = ("lining", "track", "beams", "truth", "odometry", "estimate")
NO_RECORDING = "none yet"
_LEGEND = (
    "<div style='padding:0 0.75em;font-size:0.8em;line-height:1.6'>"
    "<b style='color:#409cff'>truth</b> · <b style='color:#ff783c'>odometry</b> · "
    "<b style='color:#be6eff'>estimate ± 2 sd</b> · <b style='color:#e0a92e'>LiDAR</b> · "
    "<b style='color:#3cc878'>goal</b></div>"
)


@dataclasses.dataclass(frozen=True)
class Choice:
    """What to drive.

    Attributes:
        tunnel: Title of the tunnel.
        lining: Variant of its walls.
        task: Id of the task.
        agent: Name of who drives.
        seed: Seed of the episode.
    """

    tunnel: str
    lining: str
    task: str
    agent: str
    seed: int


class Panel:
    """The controls; what they do is attached by the session.

    Args:
        server: Where they are drawn.
        first: What is chosen at first.
        tunnels: Titles of the tunnels.
        tasks: Ids of the tasks.
        agents: Names of the agents.
        recordings: Names of the recorded episodes.
    """

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
        gui.add_html(_LEGEND)
        self.play = gui.add_button("Play")
        self.time = gui.add_slider("time, s", min=0.0, max=1.0, step=0.1, initial_value=0.0)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="2 x")
        self.camera = gui.add_dropdown("camera", cameras.MODES, initial_value=cameras.CHASE)
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
        """What is chosen now."""
        return Choice(self.tunnel.value, self.lining.value, self.task.value, self.agent.value, int(self.seed.value))

    def choose(self, choice: Choice) -> None:
        """Has the controls say what is shown."""
        put(self.tunnel, choice.tunnel)
        put(self.lining, choice.lining)
        for control, value in ((self.task, choice.task), (self.agent, choice.agent)):
            if value in control.options:
                put(control, value)
        put(self.seed, choice.seed)

    def list_recordings(self, names: tuple[str, ...], chosen: str) -> None:
        """Offers other recorded episodes."""
        self.recorded.options = names or (NO_RECORDING,)
        put(self.recorded, chosen)

    def speed_factor(self) -> float:
        """How many seconds of the episode are shown in one."""
        return float(self.speed.value.split()[0])


def put(control: Any, value: Any) -> None:
    """Sets a control; mypy takes the value of viser's controls for one that cannot be set."""
    control.value = value
