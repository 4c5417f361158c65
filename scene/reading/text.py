"""Numbers in lines of text, in bounded blocks: what ASCII PLY, ASCII PCD and tables have in common."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

_BLOCK = 1 << 22  # bytes


@dataclass(frozen=True)
class Lines:
    """Where numbers stand in a text file.

    Attributes:
        path: The file.
        columns: Which to read, in this order.
        delimiter: Between them; `None` for any white space.
        start: Byte of the first line of numbers.
        line: Its number, from 1, for messages.
        count: Lines to read; all where `None`.
        decimal_comma: Whether `1,5` means one and a half.
    """

    path: Path
    columns: tuple[int, ...]
    delimiter: str | None = None
    start: int = 0
    line: int = 1
    count: int | None = None
    decimal_comma: bool = False

    def rows(self) -> Iterator[Float[np.ndarray, "n k"]]:
        """The columns as numbers, block by block.

        Raises:
            ValueError: A line does not hold them, or there are fewer lines than promised; says which.
        """
        line, left = self.line, self.count
        with self.path.open("rb") as file:
            file.seek(self.start)
            rest = b""
            while block := file.read(_BLOCK):
                whole, _, rest = (rest + block).rpartition(b"\n")
                breaks = whole.count(b"\n") + 1 if whole else 0
                if len(rest) > _BLOCK:
                    raise ValueError(f"line {line + breaks} does not end")
                if whole.strip():
                    rows = self.parse(whole, line, left)
                    left = None if left is None else left - len(rows)
                    yield rows
                line += breaks
                if left == 0:
                    return
            if rest.strip():
                rows = self.parse(rest, line, left)
                left = None if left is None else left - len(rows)
                yield rows
        if left:
            raise ValueError(f"it ends after {(self.count or 0) - left} of {self.count} points")

    def parse(self, block: bytes, first: int, limit: int | None = None) -> Float[np.ndarray, "n k"]:
        """The columns of a block of whole lines.

        Args:
            block: The lines.
            first: Number of the first one, for messages.
            limit: Largest number of rows.

        Raises:
            ValueError: A line does not hold them; says which.
        """
        lines = block.decode("utf-8", "replace").splitlines()
        if self.decimal_comma:
            lines = [line.replace(",", ".") for line in lines]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a block of comments alone holds no data, and that is no fault
                rows = np.loadtxt(
                    lines, delimiter=self.delimiter, usecols=self.columns, ndmin=2, comments="#", max_rows=limit
                )
        except ValueError as error:
            raise ValueError(self._first_bad(lines, first) or str(error)) from error
        return rows.reshape(-1, len(self.columns))

    def _first_bad(self, lines: list[str], first: int) -> str | None:
        """The line that is at fault: the one-line parser is asked again, so that it agrees with itself."""
        for index, line in enumerate(lines):
            try:
                if line.strip():
                    np.loadtxt([line], delimiter=self.delimiter, usecols=self.columns, ndmin=2, comments="#")
            except ValueError:
                shown = line if len(line) <= 60 else line[:60] + "…"
                return f"line {first + index} has no numbers in columns {[c + 1 for c in self.columns]}: {shown!r}"
        return None
