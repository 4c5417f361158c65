"""One viewer: what its controls do."""

import threading
from collections.abc import Callable
from typing import Any

import viser

from subterra_jax.errors import SubterraError
from subterra_jax.viewer import recording
from subterra_jax.viewer.config import ViewerConfig
from subterra_jax.viewer.drivers import TASKS
from subterra_jax.viewer.errors import ViewerError
from subterra_jax.viewer.library import Library
from subterra_jax.viewer.panel import NO_RECORDING, Choice, Panel
from subterra_jax.viewer.pictures import save_picture
from subterra_jax.viewer.screening import Screening
from subterra_jax.viewer.worker import Worker


class Session:
    """The controls, and what they are attached to. All who have the page open share them.

    Args:
        server: Where it is shown.
        config: What to show first.
        library: What can be chosen.

    Attributes:
        panel: The controls.
        screening: What is being shown.
        worker: Who does what takes long.
    """

    def __init__(self, server: viser.ViserServer, config: ViewerConfig, library: Library):
        self._server, self._library = server, library
        first = Choice(next(iter(library.tunnels)), config.lining, config.task, config.agent, config.seed)
        self.panel = Panel(server, first, tuple(library.tunnels), TASKS, library.agents, library.recordings())
        self.screening = Screening(server, self.panel, library, self.complain)
        self.worker = Worker(self.complain)
        self._developing = threading.Lock()
        self._attach()

    def start(self, replay: recording.Recording | None = None) -> None:
        """Shows the tunnel, then the first episode: a recorded one, or what is chosen."""
        self.screening.raise_curtain(self.panel.choice)
        if replay is None:
            self.drive()
        else:
            self.worker.do(lambda stale: self.screening.replay(replay))

    def stop(self) -> None:
        """Ends the threads."""
        self.worker.stop()
        self.screening.player.stop()

    def complain(self, sentence: str) -> None:
        """Tells everybody what went wrong."""
        self.panel.status.content = f"**{sentence}**"
        for client in self._server.get_clients().values():
            client.add_notification("That did not work", sentence, color="red", auto_close_seconds=10.0)

    def drive(self) -> None:
        """Drives what is chosen."""
        choice = self.panel.choice
        self.worker.do(lambda stale: self.screening.drive(choice, stale))

    def replay(self) -> None:
        """Shows the recorded episode that is chosen."""
        name = self.panel.recorded.value
        if name == NO_RECORDING:
            self.complain("no episode has been recorded yet: press Save episode first")
        else:
            self.worker.do(lambda stale: self.screening.replay(self._library.recorded(name)))

    def save(self) -> str:
        """Saves the episode that is shown; returns where.

        Raises:
            RecordingError: There is none, it is still being driven, or it cannot be written.
        """
        film = self.screening.player.film
        if film is None or not film.whole:
            raise recording.RecordingError("there is no finished episode to save yet")
        path = self._library.path_for(film.recording.file_name)
        recording.save(film.recording, path)
        self.panel.list_recordings(self._library.recordings(), path.name)
        return str(path)

    def picture(self, client: viser.ClientHandle) -> str:
        """Saves what a browser shows; returns where.

        Raises:
            ViewerError: It gave no picture, it cannot be written, or another is being taken.
        """
        player = self.screening.player
        stem = "tunnel" if player.film is None else player.film.recording.file_name.removesuffix(".npz")
        path = self._library.path_for(f"{stem}_{player.time:.1f}s.png")
        if not self._developing.acquire(blocking=False):
            raise ViewerError("a picture is being taken already")
        try:
            save_picture(client, path)
        finally:
            self._developing.release()
        return str(path)

    def _attach(self) -> None:
        """Says what each control does."""
        panel, screening = self.panel, self.screening
        player = screening.player
        panel.play.on_click(lambda event: player.toggle())
        panel.time.on_update(lambda event: None if event.client is None else player.seek(panel.time.value))
        panel.speed.on_update(lambda event: self._set_speed())
        panel.camera.on_update(lambda event: screening.look())
        panel.drive.on_click(lambda event: self.drive())
        panel.replay.on_click(lambda event: self.replay())
        panel.save.on_click(self._reporting(lambda client: self.save()))
        panel.picture.on_click(self._reporting(self.picture))
        panel.cutaway.on_update(lambda event: screening.scenes.set_cutaway(panel.cutaway.value))
        for name, box in panel.show.items():
            box.on_update(self._switching(name))
        self._server.on_client_connect(screening.look)
        self._set_speed()

    def _set_speed(self) -> None:
        self.screening.player.speed = self.panel.speed_factor()

    def _switching(self, name: str) -> Callable[[Any], None]:
        return lambda event: self.screening.stage.set_visible(name, self.panel.show[name].value)

    def _reporting(self, action: Callable[[viser.ClientHandle], str]) -> Callable[[Any], None]:
        """An action that tells the browser that asked for it how it went."""

        def told(event: Any) -> None:
            if event.client is None:
                return
            try:
                event.client.add_notification("Saved", action(event.client), auto_close_seconds=6.0)
            except SubterraError as error:
                self.complain(str(error))

        return told
