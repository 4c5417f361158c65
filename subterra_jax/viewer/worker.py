"""One thread for long work, of which only the newest matters."""

import logging
import threading
from collections.abc import Callable

from subterra_jax.errors import SubterraError

Job = Callable[[Callable[[], bool]], None]
_LOG = logging.getLogger(__name__)


class Worker:
    """Does the newest job it was given; one under way is told when it has become stale.

    Args:
        complain: Called with a sentence where a job fails.
    """

    def __init__(self, complain: Callable[[str], None]):
        self._complain = complain
        self._waiting: Job | None = None
        self._newest = 0
        self._ready = threading.Condition()
        self._done = False
        self._thread = threading.Thread(target=self._loop, name="worker", daemon=True)
        self._thread.start()

    def do(self, job: Job) -> None:
        """Does a job as soon as the one under way has noticed that it is stale.

        Args:
            job: Called with a function that says whether it has become stale, which it is to ask now and then.
        """
        with self._ready:
            self._waiting, self._newest = job, self._newest + 1
            self._ready.notify()

    def stop(self) -> None:
        """Does no further job."""
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
                self._complain(str(error))
            except Exception as error:  # the next job is to find somebody who does it
                _LOG.exception("a job failed")
                self._complain(f"{type(error).__name__}: {error}")
