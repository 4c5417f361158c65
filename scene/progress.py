"""Progress of long work: bars in a terminal, lines elsewhere."""

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

_LINE_EVERY, _LINE_FRACTION = 10.0, 0.1  # s, and fraction of a stage, between two lines where there is no terminal


class _Rate(ProgressColumn):
    """Column with the steps per second."""

    def render(self, task: Task) -> Text:
        """Return the rate; empty until there is one."""
        return Text("" if not task.speed else f"{task.speed:.3g}/s")


class Stage:
    """One stage of long work, whose steps are counted.

    Attributes:
        name: Name of the stage.
        total: Number of steps in all; `None` where nobody knows.
        done: Number of steps so far.
    """

    def __init__(self, bars: Progress, console: Console, name: str, total: int | None) -> None:
        self.name, self.total, self.done = name, total, 0
        self._bars, self._console = bars, console
        self._task = bars.add_task(name, total=total)
        self._started = self._line_at = time.monotonic()
        self._first = self._line_done = 0

    def expect(self, total: int | None) -> None:
        """Sets the number of steps in all, once it is known."""
        self.total = total
        self._bars.update(self._task, total=total)

    def advance(self, steps: int = 1) -> None:
        """Counts steps."""
        self.done += steps
        self._bars.advance(self._task, steps)
        if not self._console.is_terminal and self.total:
            self._line()

    def resume(self, done: int) -> None:
        """Goes on from a partial result, and says so."""
        self.done = self._first = self._line_done = done
        self._bars.update(self._task, completed=done)
        where = f"at {100 * done / self.total:.0f} %" if self.total else f"after {done:,}"
        print(f"Resumed {where} of {self.name}", flush=True)

    def _line(self) -> None:
        """Prints one line for each tenth of a stage that lasts."""
        now = time.monotonic()
        steps = self.done - self._line_done
        if now - self._line_at < _LINE_EVERY or steps < _LINE_FRACTION * (self.total or 0) or self.done == self.total:
            return
        self._line_at, self._line_done = now, self.done
        rate = (self.done - self._first) / (now - self._started)
        left = max((self.total or 0) - self.done, 0) / rate
        text = f"{self.name}: {self.done / (self.total or 1):.0%}, {rate:.3g}/s, {left:.0f} s left"
        print(text, file=self._console.file, flush=True)


class Stages:
    """Shows on stderr how far long stages are: bars in a terminal, else a line for each tenth of those that last."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
        self._bars = Progress(*columns, console=self._console, disable=not self._console.is_terminal)

    def __enter__(self) -> "Stages":
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def start(self, name: str, total: int | None) -> Stage:
        """Starts a stage below the others, of `total` steps; `None` where nobody knows."""
        return Stage(self._bars, self._console, name, total)
