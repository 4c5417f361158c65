"""A session of the viewer: the episode that is shown, and the effect of each control."""

import contextlib
import io
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser

from subterra_jax import tasks
from subterra_jax.host.errors import SubterraError
from subterra_jax.viewer import browsers, recording
from subterra_jax.viewer.config import ViewerConfig, ViewerError, check_config, free_port
from subterra_jax.viewer.geometry import Centreline, EpisodeGeometry, Moment
from subterra_jax.viewer.library import Library, TunnelView, drive_episode, task_names
from subterra_jax.viewer.panel import NO_RECORDING, Choice, Panel, set_value, status_text
from subterra_jax.viewer.player import Player, Worker
from subterra_jax.viewer.recording import Recording
from subterra_jax.viewer.scene import SceneView

_PANEL_PERIOD = 0.2  # s, between two updates of text and charts: faster text cannot be read


class EpisodeView:
    """The episode on screen, shared by all who have the page open.

    `report_error` is called with a sentence if the details of a scene cannot be read.
    """

    def __init__(
        self, server: viser.ViserServer, panel: Panel, library: Library, report_error: Callable[[str], None]
    ) -> None:
        self._server, self._panel, self._library = server, panel, library
        self.scene_view = SceneView(server)
        self.tunnel_view = TunnelView(self.scene_view, library, report_error)
        self.player = Player(self.show)
        self._centreline: Centreline | None = None
        self._moment: Moment | None = None
        self._note = ""
        self._panel_at = 0.0
        self._visited = False

    def welcome(self, client: viser.ClientHandle) -> None:
        """Place the camera of a browser that has just connected; the first one starts the episode that waits for it."""
        self.place_cameras(client)
        if not self._visited:
            self._visited = True
            self.player.play()

    def start(self, choice: Choice) -> None:
        """Show the tunnel of a choice, still without an episode, and start the clock.

        Raises:
            SubterraError: The tunnel cannot be read, or does not have the lining.
        """
        piece = tasks.TASKS[choice.task].piece if choice.task in tasks.TASKS else None
        lining = self.tunnel_view.choose_lining(choice.tunnel, choice.lining)
        self._centreline = self.tunnel_view.show(choice.tunnel, lining, np.inf if piece is None else piece[1])
        self.player.start()

    def drive(self, choice: Choice, stale: Callable[[], bool]) -> None:
        """Drive an episode and show it meanwhile.

        Args:
            choice: Tunnel, task, driver and seed.
            stale: Returns whether a newer job waits.

        Raises:
            SubterraError: The tunnel cannot be read, or the driver does not fit the task.
            ValueError: The tunnel is too short for the task.
        """
        lining = self.tunnel_view.choose_lining(choice.tunnel, choice.lining)
        self.player.pause()
        self._panel.status.content = f"*making {choice.agent} ready; the first time takes some seconds*"
        plan, digest = self._library.plan(choice.tunnel), self._library.digest(choice.tunnel)
        episode = None
        named = (choice.tunnel, lining, choice.task, choice.agent, choice.seed)
        for part in drive_episode(plan, digest, *named, self._library.sensor):
            if stale():
                return
            if episode is None:
                episode = self._show_recording(part, choice.tunnel, finished=False)
            else:
                episode = EpisodeGeometry(part, episode.centreline, finished=False)
                self.player.grow(episode)
        if episode is not None:
            self.player.grow(EpisodeGeometry(episode.recording, episode.centreline))
            self.player.refresh()

    def replay(self, recording: Recording) -> None:
        """Show a recorded episode.

        Raises:
            ViewerError: Its tunnel is not in the library.
        """
        title = self._library.find_tunnel(recording)
        self._show_recording(recording, title, finished=True)
        self._panel.choose(Choice(title, recording.lining, recording.task, recording.agent, int(recording.seed)))

    def show(self, episode: EpisodeGeometry, moment: Moment, full: bool) -> None:
        """Show one moment: the scene at once, text and charts every `_PANEL_PERIOD` or if `full`."""
        self._moment = moment
        self.scene_view.show(episode, moment, full)
        if self.player.playing or full:
            self.place_cameras()
        now = time.monotonic()
        if full or now - self._panel_at >= _PANEL_PERIOD:
            self._panel_at = now
            self._update_panel(episode, moment)

    def place_cameras(self, client: viser.ClientHandle | None = None) -> None:
        """Place the camera of a browser that has just connected, or of all browsers."""
        centreline, mode = self._centreline, self._panel.camera.value
        if centreline is None:
            return
        if client is not None and mode == browsers.FREE:
            mode = browsers.CHASE
        pose = browsers.camera_pose(mode, centreline, self._moment)
        if pose is not None:
            for each in [client] if client is not None else list(self._server.get_clients().values()):
                browsers.move_camera(each, *pose)

    def _show_recording(self, recording: Recording, title: str, *, finished: bool) -> EpisodeGeometry:
        """Show an episode from its start; it plays once somebody has come to see it."""
        centreline = self.tunnel_view.show(title, recording.lining, recording.length)
        episode = EpisodeGeometry(recording, centreline, finished=finished)
        self._centreline, self._note = centreline, self.tunnel_view.note(title)
        self.scene_view.set_episode(episode, centreline)
        self.player.begin(episode, playing=self._visited)
        return episode

    def _update_panel(self, episode: EpisodeGeometry, moment: Moment) -> None:
        panel = self._panel
        rate = f" <small>· {self.player.frames_per_second:.0f} frames/s</small>" if self.player.playing else ""
        with self._server.atomic():
            panel.time.max = max(episode.recording.duration, 0.1)
            set_value(panel.time, round(moment.row * episode.recording.period, 3))
            panel.play.label = "Pause" if self.player.playing else "Play"
            panel.charts.show(episode, moment.row)
            panel.show_legend(episode.recording)
            text = status_text(episode.recording, moment.row, finished=episode.finished, note=self._note)
            panel.status.content = text + rate


class Session:
    """The controls and their effects, shared by all who have the page open."""

    def __init__(self, server: viser.ViserServer, config: ViewerConfig, library: Library):
        self._server, self._library = server, library
        first = Choice(next(iter(library.tunnels)), config.lining, config.task, config.agent, config.seed)
        self.panel = Panel(server, first, tuple(library.tunnels), task_names(), library.agents, library.recordings())
        self.view = EpisodeView(server, self.panel, library, self.report_error)
        self.worker = Worker(self.report_error)
        self._picture_lock = threading.Lock()
        self._attach()

    def start(self, replay: Recording | None = None) -> None:
        """Show the tunnel, then the first episode: a recorded one, or the choice of the panel."""
        self.view.start(self.panel.choice)
        if replay is None:
            self.drive()
        else:
            self.worker.submit(lambda stale: self.view.replay(replay))

    def stop(self) -> None:
        self.worker.stop()
        self.view.player.stop()

    def report_error(self, sentence: str) -> None:
        self.panel.status.content = f"**{sentence}**"
        for client in self._server.get_clients().values():
            client.add_notification("That did not work", sentence, color="red", auto_close_seconds=10.0)

    def drive(self) -> None:
        choice = self.panel.choice
        self.worker.submit(lambda stale: self.view.drive(choice, stale))

    def replay(self) -> None:
        name = self.panel.recorded.value
        if name == NO_RECORDING:
            self.report_error("no episode has been recorded yet: press Save episode first")
        else:
            self.worker.submit(lambda stale: self.view.replay(self._library.load_recording(name)))

    def save(self) -> str:
        """Save the episode on screen; return its path.

        Raises:
            EpisodeFileError: No episode is finished.
            OutputError: The file cannot be written.
        """
        episode = self.view.player.episode
        if episode is None or not episode.finished:
            raise recording.EpisodeFileError("there is no finished episode to save yet")
        path = self._library.path_for(episode.recording.file_name)
        recording.save(episode.recording, path)
        self.panel.list_recordings(self._library.recordings(), path.name)
        return str(path)

    def picture(self, client: viser.ClientHandle) -> str:
        """Save a browser's picture; return its path.

        Raises:
            ViewerError: The browser sent no picture, or another picture is being taken.
            OutputError: The file cannot be written.
        """
        player = self.view.player
        stem = "tunnel" if player.episode is None else player.episode.recording.file_name.removesuffix(".npz")
        path = self._library.path_for(f"{stem}_{player.time:.1f}s.png")
        if not self._picture_lock.acquire(blocking=False):
            raise ViewerError("a picture is being taken already")
        try:
            browsers.save_picture(client, path)
        finally:
            self._picture_lock.release()
        return str(path)

    def _attach(self) -> None:
        panel, view = self.panel, self.view
        player = view.player
        panel.play.on_click(lambda event: player.toggle())
        panel.time.on_update(lambda event: None if event.client is None else player.seek(panel.time.value))
        panel.speed.on_update(lambda event: self._set_speed())
        panel.camera.on_update(lambda event: view.place_cameras())
        panel.drive.on_click(lambda event: self.drive())
        panel.replay.on_click(lambda event: self.replay())
        panel.save.on_click(self._report_result(lambda client: self.save()))
        panel.picture.on_click(self._report_result(self.picture))
        panel.cutaway.on_update(lambda event: view.tunnel_view.set_cutaway(panel.cutaway.value))
        for name, box in panel.show.items():
            box.on_update(self._set_visibility(name))
        self._server.on_client_connect(view.welcome)
        self._set_speed()

    def _set_speed(self) -> None:
        self.view.player.speed = self.panel.speed_factor()

    def _set_visibility(self, name: str) -> Callable[[Any], None]:
        return lambda event: self.view.scene_view.set_visible(name, self.panel.show[name].value)

    def _report_result(self, action: Callable[[viser.ClientHandle], str]) -> Callable[[Any], None]:
        """Wrap an action so that the browser that asked for it sees the result."""

        def run(event: Any) -> None:
            if event.client is None:
                return
            try:
                event.client.add_notification("Saved", action(event.client), auto_close_seconds=6.0)
            except SubterraError as error:
                self.report_error(str(error))

        return run


class Viewer:
    """A running viewer, its page at `url`; all browsers share one session.

    Raises:
        SubterraError: A file, task, driver or port of the config is not available.
    """

    def __init__(self, config: ViewerConfig):
        config = check_config(config)
        library = Library(config)
        replay = None if config.replay is None else recording.load(Path(config.replay))
        port = free_port(config.host, config.port)
        with contextlib.redirect_stdout(io.StringIO()):  # the command prints the address itself
            self.server = viser.ViserServer(host=config.host, port=port, verbose=False)
        browsers.restrict_messages(self.server)
        self.session = Session(self.server, config, library)
        shown = "127.0.0.1" if config.host == "0.0.0.0" else config.host
        self.url = f"http://{f'[{shown}]' if ':' in shown else shown}:{self.server.get_port()}"
        self.session.start(replay)

    def stop(self) -> None:
        self.session.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
