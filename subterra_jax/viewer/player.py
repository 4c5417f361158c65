"""The clock of a replay: play, pause, seek, speed."""

import logging
import threading
import time
from collections.abc import Callable

from subterra_jax.viewer.frames import Film, Frame

RATE = 40.0  # frames/s that are aimed at; a screen shows 60, an episode has 10 rows a second
_LOG = logging.getLogger(__name__)


class Player:
    """Shows an episode moment by moment, on a thread of its own.

    Args:
        show: Called with the film, the moment, and whether it must be shown in full (after a seek, a stop, a new
            episode) and not only moved on.
    """

    def __init__(self, show: Callable[[Film, Frame, bool], None]):
        self._show = show
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._film: Film | None = None
        self._at, self._dirty = 0.0, False
        self.playing, self.speed = False, 1.0
        self.frames_per_second = 0.0
        self._thread = threading.Thread(target=self._loop, name="player", daemon=True)

    @property
    def film(self) -> Film | None:
        """What is being shown."""
        return self._film

    @property
    def time(self) -> float:
        """Time since the start of the episode, s."""
        film = self._film
        return 0.0 if film is None else self._at * film.recording.period

    def start(self) -> None:
        """Starts the clock."""
        self._thread.start()

    def stop(self) -> None:
        """Stops the clock for good."""
        self._stop.set()
        self._thread.join(timeout=2.0)

    def begin(self, film: Film, *, playing: bool) -> None:
        """Another episode, from its start."""
        with self._lock:
            self._film, self._at, self.playing, self._dirty = film, 0.0, playing, True

    def grow(self, film: Film) -> None:
        """The same episode, longer than before."""
        with self._lock:
            self._film = film

    def seek(self, seconds: float) -> None:
        """Goes to a time of the episode, s; clipped to it."""
        with self._lock:
            if self._film is not None:
                rows = round(seconds / self._film.recording.period, 4)  # 0.3 s are three rows of 0.1 s
                self._at, self._dirty = min(max(rows, 0.0), len(self._film) - 1.0), True

    def toggle(self) -> None:
        """Plays or pauses; plays from the start where the end has been reached."""
        with self._lock:
            if self._film is None:
                return
            if not self.playing and self._at >= len(self._film) - 1:
                self._at = 0.0
            self.playing, self._dirty = not self.playing, True

    def pause(self) -> None:
        """Stands still."""
        with self._lock:
            self.playing, self._dirty = False, True

    def refresh(self) -> None:
        """Has the present moment shown again."""
        with self._lock:
            self._dirty = True

    def advance(self, seconds: float) -> tuple[Film, Frame, bool] | None:
        """Lets time pass.

        Args:
            seconds: How much of it, s, before the speed is counted in.

        Returns:
            What to show now; None where nothing has changed.
        """
        with self._lock:
            film = self._film
            if film is None or not (self.playing or self._dirty):
                return None
            last = len(film) - 1.0
            if self.playing:
                self._at = min(self._at + seconds * self.speed / film.recording.period, last)
            if self.playing and self._at >= last and film.whole:
                self.playing, self._dirty = False, True
            full, self._dirty = self._dirty, False
            return film, film.frame(self._at), full

    def _loop(self) -> None:
        before, counted, since = time.monotonic(), 0, time.monotonic()
        while not self._stop.wait(max(0.0, before + 1.0 / RATE - time.monotonic())):
            now = time.monotonic()
            passed, before = now - before, now
            try:
                moment = self.advance(min(passed, 0.5))
                if moment is not None:
                    self._show(*moment)
                    counted += 1
            except Exception:  # whatever a browser did, the others go on watching
                _LOG.exception("a frame could not be shown")
            if now - since >= 1.0:
                self.frames_per_second, counted, since = counted / (now - since), 0, now
