"""Two threads: the clock of a replay, and a worker for long jobs."""

import logging
import threading
import time
from collections.abc import Callable

from subterra_jax.host.errors import SubterraError
from subterra_jax.viewer.geometry import EpisodeGeometry, Moment

RATE = 40.0  # target, frames/s; a screen shows 60, an episode has 10 rows a second
_LOG = logging.getLogger(__name__)


class Player:
    """Clock of a replay: plays, pauses and seeks an episode on its own thread.

    Args:
        show: Called with the episode, the moment, and whether everything must be drawn again, as after a seek, a stop
            or a new episode.

    Attributes:
        playing: Whether time passes.
        speed: Seconds of the episode per second.
        frames_per_second: Frames shown in the last second.
    """

    def __init__(self, show: Callable[[EpisodeGeometry, Moment, bool], None]):
        self._show = show
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._episode: EpisodeGeometry | None = None
        self._at, self._dirty = 0.0, False
        self.playing, self.speed = False, 1.0
        self.frames_per_second = 0.0
        self._thread = threading.Thread(target=self._loop, name="player", daemon=True)

    @property
    def episode(self) -> EpisodeGeometry | None:
        return self._episode

    @property
    def time(self) -> float:
        """Time since the start of the episode, s."""
        episode = self._episode
        return 0.0 if episode is None else self._at * episode.recording.period

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(timeout=2.0)

    def begin(self, episode: EpisodeGeometry, *, playing: bool) -> None:
        with self._lock:
            self._episode, self._at, self.playing, self._dirty = episode, 0.0, playing, True

    def grow(self, episode: EpisodeGeometry) -> None:
        with self._lock:
            self._episode = episode

    def seek(self, seconds: float) -> None:
        """Go to a time of the episode, s; clipped to its end."""
        with self._lock:
            if self._episode is not None:
                rows = round(seconds / self._episode.recording.period, 4)  # 0.3 s are three rows of 0.1 s
                self._at, self._dirty = min(max(rows, 0.0), len(self._episode) - 1.0), True

    def play(self) -> None:
        with self._lock:
            if self._episode is not None:
                self.playing, self._dirty = True, True

    def toggle(self) -> None:
        """Play or pause; play from the start after the end."""
        with self._lock:
            if self._episode is None:
                return
            if not self.playing and self._at >= len(self._episode) - 1:
                self._at = 0.0
            self.playing, self._dirty = not self.playing, True

    def pause(self) -> None:
        with self._lock:
            self.playing, self._dirty = False, True

    def refresh(self) -> None:
        with self._lock:
            self._dirty = True

    def advance(self, seconds: float) -> tuple[EpisodeGeometry, Moment, bool] | None:
        """Advance the replay.

        Args:
            seconds: Time that has passed, s, without the factor `speed`.

        Returns:
            Arguments of `show`; `None` if nothing has changed.
        """
        with self._lock:
            episode = self._episode
            if episode is None or not (self.playing or self._dirty):
                return None
            last = len(episode) - 1.0
            if self.playing:
                self._at = min(self._at + seconds * self.speed / episode.recording.period, last)
            if self.playing and self._at >= last and episode.finished:
                self.playing, self._dirty = False, True
            full, self._dirty = self._dirty, False
            return episode, episode.moment(self._at), full

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
            except Exception:  # the other browsers must go on
                _LOG.exception("a frame could not be shown")
            if now - since >= 1.0:
                self.frames_per_second, counted, since = counted / (now - since), 0, now


Job = Callable[[Callable[[], bool]], None]


class Worker:
    """Runs the newest job on its own thread; a running job can ask whether a newer one waits.

    `report_error` is called with a sentence if a job fails.
    """

    def __init__(self, report_error: Callable[[str], None]):
        self._report_error = report_error
        self._waiting: Job | None = None
        self._newest = 0
        self._ready = threading.Condition()
        self._done = False
        self._thread = threading.Thread(target=self._loop, name="worker", daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> None:
        """Run a job once the running one has ended.

        Args:
            job: Called with a function that returns whether a newer job waits; the job should ask it often.
        """
        with self._ready:
            self._waiting, self._newest = job, self._newest + 1
            self._ready.notify()

    def stop(self) -> None:
        with self._ready:
            self._done, self._newest = True, self._newest + 1
            self._ready.notify()
        self._thread.join(timeout=5.0)

    def _loop(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._done or self._waiting is not None)
                if self._done or self._waiting is None:
                    return
                job, number, self._waiting = self._waiting, self._newest, None
            try:
                job(lambda number=number: self._newest != number)  # type: ignore[misc]
            except (SubterraError, ValueError) as error:
                self._report_error(str(error))
            except Exception as error:  # the thread must live on for the next job
                _LOG.exception("a job failed")
                self._report_error(f"{type(error).__name__}: {error}")
