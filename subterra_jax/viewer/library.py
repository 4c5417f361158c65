"""What can be chosen: tunnels, tasks, agents, recorded episodes. Nothing else is ever read."""

import dataclasses
from pathlib import Path

import numpy as np

from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import PACKAGED, load_tunnel, tunnel_digest
from subterra_jax.viewer import drivers
from subterra_jax.viewer.config import ViewerConfig
from subterra_jax.viewer.errors import RecordingError, ViewerError
from subterra_jax.viewer.recording import Recording, load

_GENERATED = ("control", "procedural:test:0", "procedural:test:1", "procedural:test:2")


@dataclasses.dataclass(frozen=True)
class Tunnel:
    """A tunnel that can be chosen.

    Attributes:
        title: What it is called in the list.
        source: What `load_tunnel` takes.
        scene: The scene folder with its lining and track; None where there is only the plan.
    """

    title: str
    source: str
    scene: Path | None = None


class Library:
    """Everything that the viewer was given.

    Args:
        config: What it was given.

    Raises:
        SubterraError: A tunnel or a policy of the command line cannot be read, or there is no such driver.
    """

    def __init__(self, config: ViewerConfig):
        self._folder = config.recordings
        self._plans: dict[str, TunnelPlan] = {}
        self.tunnels: dict[str, Tunnel] = {}
        if config.scene is not None:
            source = str(config.scene / "tunnel.npz")
            name = f"{load_tunnel(source).name} (scene)"
            self.tunnels[name] = Tunnel(name, source, config.scene)
        for source in (*config.tunnels, *PACKAGED, *_GENERATED):
            self.tunnels.setdefault(source, Tunnel(source, source))
        for source in config.tunnels:
            self.plan(source)
        self.agents = drivers.offer(config.policies)
        if config.agent not in self.agents:
            raise ViewerError(f"no driver {config.agent!r}; there are {', '.join(self.agents)}")

    def plan(self, title: str) -> TunnelPlan:
        """A tunnel, read when it is first asked for.

        Raises:
            ViewerError: It is not on the list.
            TunnelError: It cannot be read.
        """
        if title not in self.tunnels:
            raise ViewerError(f"no tunnel {title!r}; there are {', '.join(self.tunnels)}")
        if title not in self._plans:
            self._plans[title] = load_tunnel(self.tunnels[title].source)
        return self._plans[title]

    def digest(self, title: str) -> str:
        """SHA-256 of a tunnel."""
        return tunnel_digest(self.tunnels[title].source)

    def recordings(self) -> tuple[str, ...]:
        """Names of the recorded episodes in the folder."""
        return tuple(sorted(path.name for path in self._folder.glob("*.npz") if path.is_file()))

    def recorded(self, name: str) -> Recording:
        """One of them.

        Raises:
            RecordingError: It is not in the folder, or cannot be read.
        """
        if name not in self.recordings():
            raise RecordingError(f"no recording {name!r} in {self._folder}")
        return load(self._folder / name)

    def tunnel_of(self, recording: Recording) -> str:
        """Title of the tunnel that an episode was recorded in, wherever that file lies now.

        Raises:
            ViewerError: The viewer was not given that tunnel, or its file has changed since.
        """
        named = [title for title in self.tunnels if title == recording.tunnel]
        for title in (*named, *(title for title in self.tunnels if title not in named)):
            if self.digest(title) == recording.tunnel_sha256:
                return title
        raise ViewerError(
            f"this episode was recorded in a tunnel {recording.tunnel!r} that the viewer was not given: "
            "name its file with --tunnel, or its scene folder with --scene"
        )

    def path_for(self, name: str) -> Path:
        """Where a file of that name is saved."""
        return self._folder / Path(name).name


def course_plan(plan: TunnelPlan, length: float) -> TunnelPlan:
    """The part of a tunnel that a task happens in, from its first mouth on."""
    return plan if length >= plan.length - 1e-6 or not np.isfinite(length) else plan.slice(0.0, length)
