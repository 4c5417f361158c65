"""The tunnels, tasks, agents and recorded episodes to choose from; no other file is ever read."""

import dataclasses
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import subterra_jax as st
from subterra_jax import policies, tasks
from subterra_jax.baselines import registry
from subterra_jax.host.errors import SubterraError
from subterra_jax.host.loading import load_object
from subterra_jax.host.task_ids import MISSIONS, WALK
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.policies.opening import FORMS, names_code, policy_source
from subterra_jax.tasks import first_tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import PACKAGED, load_tunnel, tunnel_digest
from subterra_jax.viewer.config import ViewerConfig, ViewerError
from subterra_jax.viewer.driving import drive
from subterra_jax.viewer.geometry import Centreline, lining_shape, planar_shapes, scene_shapes
from subterra_jax.viewer.recording import EpisodeFileError, Recording, load
from subterra_jax.viewer.scene import SceneView


def task_names() -> tuple[str, ...]:
    """Return the ids of the tasks that the viewer shows, those of the user's own included."""
    return (*tasks.TASKS, *MISSIONS)


def driver_names(files: tuple[Path, ...] = (), chosen: str | None = None) -> tuple[str, ...]:
    """Return the names of all drivers: baselines, released policies, files of the command line, and its own driver.

    Args:
        files: Trained policies, as files or run folders.
        chosen: The driver of the command line, as for `policies.open_agent`.

    Raises:
        PolicyError: A policy is missing or damaged.
        UserCodeError: The class cannot be loaded.
        ViewerError: There is no such driver.
    """
    released = [policies.PREFIX + name for name in policies.released() if name != policies.name_for(WALK)]
    for path in files:
        policies.load(path)
    names = (*registry.names(), *sorted(released), *(f"{policies.PREFIX}{path}" for path in files))
    names = tuple(dict.fromkeys(names))
    if chosen is None or chosen in names:
        return names
    if (source := policy_source(chosen)) is not None:
        policies.load(source)
    elif names_code(chosen):
        load_object(chosen)
    else:
        raise ViewerError(f"no driver {chosen!r}; there are {', '.join(names)}; or {FORMS}")
    return (*names, chosen)


def drive_episode(
    plan: TunnelPlan,
    digest: str,
    title: str,
    lining: str,
    task: str,
    agent: str,
    seed: int,
    sensor: str = SENSORS[0],
) -> Iterator[Recording]:
    """Drive an episode; yield the recording so far, again and again.

    Args:
        plan: The tunnel.
        digest: SHA-256 of the tunnel, for the recording.
        title: Name of the tunnel, for the recording.
        lining: As for `subterra_jax.make`.
        task: As for `subterra_jax.make`.
        agent: As for `policies.open_agent`.
        seed: Seed of the episode.
        sensor: As for `subterra_jax.make`.

    Raises:
        SubterraError: The agent does not exist, or does not fit the task.
        ValueError: The task does not exist, or the tunnel is too short for it.
    """
    legs: dict[str, Any] = {"engine": "mujoco"} if task in MISSIONS else {}
    env, params = st.make(task, tunnel=plan, lining=lining, sensor=sensor, **legs)
    driver = policies.open_agent(agent, env, params)
    names = {"tunnel": title, "tunnel_sha256": digest, "lining": lining, "agent": agent}
    yield from drive(env, params, driver, seed, names)


_GENERATED = ("control", "open:val:0", "open:val:1", "open:val:2")


@dataclasses.dataclass(frozen=True)
class TunnelEntry:
    """A tunnel to choose: its name in the list, its file or name for `load_tunnel`, and its scene folder, if any."""

    title: str
    source: str
    scene: Path | None = None


class Library:
    """The tunnels, by title, the agents, by name, and the recordings of a config.

    Raises:
        SubterraError: A tunnel or policy cannot be read, or the driver does not exist.
    """

    def __init__(self, config: ViewerConfig):
        self._folder = config.recordings
        self.sensor = config.sensor
        self._plans: dict[str, TunnelPlan] = {}
        self.tunnels: dict[str, TunnelEntry] = {}
        if config.scene is not None:
            source = str(config.scene / "tunnel.npz")
            name = f"{load_tunnel(source).name} (scene)"
            self.tunnels[name] = TunnelEntry(name, source, config.scene)
        usual = first_tunnel(config.task, spatial=config.sensor != SENSORS[0])
        for source in (*config.tunnels, usual, *PACKAGED, *_GENERATED):
            self.tunnels.setdefault(source, TunnelEntry(source, source))
        for source in config.tunnels:
            self.plan(source)
        self.agents = driver_names(config.policies, config.agent)

    def plan(self, title: str) -> TunnelPlan:
        """Return a tunnel, read at its first use.

        Raises:
            ViewerError: The tunnel is not on the list.
            TunnelError: The tunnel cannot be read.
        """
        if title not in self.tunnels:
            raise ViewerError(f"no tunnel {title!r}; there are {', '.join(self.tunnels)}")
        if title not in self._plans:
            self._plans[title] = load_tunnel(self.tunnels[title].source, solid=self.sensor != SENSORS[0])
        return self._plans[title]

    def digest(self, title: str) -> str:
        return tunnel_digest(self.tunnels[title].source)

    def recordings(self) -> tuple[str, ...]:
        return tuple(sorted(path.name for path in self._folder.glob("*.npz") if path.is_file()))

    def load_recording(self, name: str) -> Recording:
        """Read a recorded episode of the folder.

        Raises:
            EpisodeFileError: It is not in the folder, or cannot be read.
        """
        if name not in self.recordings():
            raise EpisodeFileError(f"no recording {name!r} in {self._folder}")
        return load(self._folder / name)

    def find_tunnel(self, recording: Recording) -> str:
        """Return the title of the tunnel that an episode was recorded in, found by its digest.

        Raises:
            ViewerError: The tunnel is not on the list, or its file has changed since.
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
        return self._folder / Path(name).name


class TunnelView:
    """Shows one tunnel at a time: its plan or lining at once, every detail as soon as it has been read.

    `report_error` is called with a sentence if the details of a scene cannot be read.
    """

    def __init__(self, scene_view: SceneView, library: Library, report_error: Callable[[str], None]):
        self._scene_view, self._library, self._report_error = scene_view, library, report_error
        self._shown: tuple[str, str, float] | None = None
        self.cutaway = True

    def choose_lining(self, title: str, lining: str) -> str:
        """Return the lining to show: the chosen one, or the tunnel's only one.

        Raises:
            TunnelError: The tunnel has several linings, but not the chosen one.
        """
        plan = self._library.plan(title)
        if len(plan.linings) == 1:
            return next(iter(plan.linings))
        plan.lining(lining)
        return lining

    def show(self, title: str, lining: str, length: float) -> Centreline:
        """Show the first `length` metres of a tunnel; return its centreline.

        Args:
            title: Title of the tunnel.
            lining: Variant of its walls.
            length: Length to show, m; a scene is shown as a whole.

        Raises:
            SubterraError: A file cannot be read.
        """
        plan, scene = self._library.plan(title), self._library.tunnels[title].scene
        whole = length >= plan.length - 1e-6 or not np.isfinite(length)
        centreline = Centreline(plan if whole else plan.slice(0.0, length))
        key = (title, lining, -1.0 if scene is not None else length)
        if key == self._shown:
            return centreline
        if scene is None:
            self._scene_view.set_tunnel(planar_shapes(centreline.plan, lining), cutaway=self.cutaway)
        else:
            self._scene_view.set_tunnel([lining_shape(scene, lining)], cutaway=self.cutaway)
            threading.Thread(target=self._show_details, args=(key,), daemon=True).start()
        self._shown = key
        return centreline

    def note(self, title: str) -> str:
        """Return a caveat for the picture of a tunnel; empty for a scene, which is shown as built."""
        planar = self._library.tunnels[title].scene is None
        return "walls pulled up from the plan at LiDAR height" if planar else ""

    def set_cutaway(self, cutaway: bool) -> None:
        """Draw walls from within only, or from both sides."""
        self.cutaway = cutaway
        self._scene_view.set_cutaway(cutaway)

    def _show_details(self, key: tuple[str, str, float]) -> None:
        """Replace a bare lining by the whole scene, unless another tunnel is shown by then."""
        title, lining, _ = key
        scene = self._library.tunnels[title].scene
        assert scene is not None
        try:
            shapes = scene_shapes(scene, lining)
            if lining == "smooth":
                shapes = [lining_shape(scene, lining), *shapes]
        except SubterraError as error:
            self._report_error(str(error))
            return
        if self._shown == key:
            self._scene_view.set_tunnel(shapes, cutaway=self.cutaway)
