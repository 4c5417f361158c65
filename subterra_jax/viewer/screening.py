"""What is being shown: an episode on the stage, the words and charts about it, and where the cameras are."""

import time
from collections.abc import Callable

import numpy as np
import viser

from subterra_jax.tasks import TASKS
from subterra_jax.viewer import cameras, drivers, telling
from subterra_jax.viewer.course import Course
from subterra_jax.viewer.frames import Film, Frame
from subterra_jax.viewer.library import Library
from subterra_jax.viewer.panel import Choice, Panel, put
from subterra_jax.viewer.player import Player
from subterra_jax.viewer.recording import Recording
from subterra_jax.viewer.scenes import Scenes
from subterra_jax.viewer.stage import Stage

_WORDS_EVERY = 0.2  # s, between two updates of words and charts: text that changes faster cannot be read


class Screening:
    """An episode as everybody sees it who has the page open.

    Args:
        server: Where it is shown.
        panel: The controls, which follow what is shown.
        library: Where tunnels and episodes come from.
        complain: Called with a sentence where the details of a scene cannot be read.

    Attributes:
        stage: The scene.
        scenes: Which tunnel is on it.
        player: The clock.
    """

    def __init__(
        self, server: viser.ViserServer, panel: Panel, library: Library, complain: Callable[[str], None]
    ) -> None:
        self._server, self._panel, self._library = server, panel, library
        self.stage = Stage(server)
        self.scenes = Scenes(self.stage, library, complain)
        self.player = Player(self.show)
        self._course: Course | None = None
        self._frame: Frame | None = None
        self._note = ""
        self._words_at = 0.0

    def raise_curtain(self, choice: Choice) -> None:
        """Shows the tunnel of a choice before there is an episode, and starts the clock.

        Raises:
            SubterraError: The tunnel cannot be read, or has no such lining.
        """
        piece = TASKS[choice.task].piece if choice.task in TASKS else None
        lining = self.scenes.lining_of(choice.tunnel, choice.lining)
        self._course = self.scenes.show(choice.tunnel, lining, np.inf if piece is None else piece[1])
        self.player.start()

    def drive(self, choice: Choice, stale: Callable[[], bool]) -> None:
        """Drives an episode and shows it meanwhile.

        Args:
            choice: What to drive.
            stale: Whether nobody wants to see it any more.

        Raises:
            SubterraError: The tunnel cannot be read, or the driver does not fit the task.
            ValueError: The task has no room in the tunnel.
        """
        lining = self.scenes.lining_of(choice.tunnel, choice.lining)
        self.player.pause()
        self._panel.status.content = f"*making {choice.agent} ready; the first time takes some seconds*"
        plan, digest = self._library.plan(choice.tunnel), self._library.digest(choice.tunnel)
        film = None
        for part in drivers.episode(plan, digest, choice.tunnel, lining, choice.task, choice.agent, choice.seed):
            if stale():
                return
            if film is None:
                film = self._begin(part, choice.tunnel, whole=False)
            else:
                film = Film(part, film.course, whole=False)
                self.player.grow(film)
        if film is not None:
            self.player.grow(Film(film.recording, film.course))
            self.player.refresh()

    def replay(self, recording: Recording) -> None:
        """Shows a recorded episode.

        Raises:
            ViewerError: It was recorded in a tunnel that is not in the library.
        """
        title = self._library.tunnel_of(recording)
        self._begin(recording, title, whole=True)
        self._panel.choose(Choice(title, recording.lining, recording.task, recording.agent, int(recording.seed)))

    def show(self, film: Film, frame: Frame, full: bool) -> None:
        """One moment: the stage always, words and charts now and then or if `full`."""
        self._frame = frame
        self.stage.show(film, frame, full)
        if self.player.playing or full:
            self.look()
        now = time.monotonic()
        if full or now - self._words_at >= _WORDS_EVERY:
            self._words_at = now
            self._tell(film, frame)

    def look(self, client: viser.ClientHandle | None = None) -> None:
        """Places the cameras: one that has just come, or all."""
        course, mode = self._course, self._panel.camera.value
        if course is None:
            return
        if client is not None and mode == cameras.FREE:
            mode = cameras.CHASE
        where = cameras.pose(mode, course, self._frame)
        if where is not None:
            for each in [client] if client is not None else list(self._server.get_clients().values()):
                cameras.place(each, *where)

    def _begin(self, recording: Recording, title: str, *, whole: bool) -> Film:
        """Puts an episode on the stage, from its start."""
        course = self.scenes.show(title, recording.lining, recording.length)
        film = Film(recording, course, whole=whole)
        self._course, self._note = course, self.scenes.note(title)
        self.stage.set_episode(film, course)
        self.player.begin(film, playing=True)
        return film

    def _tell(self, film: Film, frame: Frame) -> None:
        """Words, slider, button and charts."""
        panel = self._panel
        rate = f"  \n<small>{self.player.frames_per_second:.0f} frames/s</small>" if self.player.playing else ""
        with self._server.atomic():
            panel.time.max = max(film.recording.duration, 0.1)
            put(panel.time, round(frame.row * film.recording.period, 3))
            panel.play.label = "Pause" if self.player.playing else "Play"
            panel.charts.show(film, frame.row)
            words = telling.headline(film.recording, frame.row, whole=film.whole, note=self._note)
            panel.status.content = words + rate
