"""Shared by all readers: damaged files, numbers in text, units and axes, and the cloud that a reader returns."""

import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from subterra_jax.host.errors import SubterraError

_LONGEST_CAUSE = 200  # characters of a message of a library


def one_line(text: str) -> str:
    """Return the text on one line, cut to 200 characters."""
    text = " ".join(text.split()).rstrip(".")
    return text if len(text) <= _LONGEST_CAUSE else text[:_LONGEST_CAUSE] + "…"


def cause(error: BaseException) -> str:
    """Return an error's text on one line; its type where it has none."""
    return one_line(str(error)) or type(error).__name__


@contextmanager
def refuse_damage(path: Path, what: str, kind: type[SubterraError]) -> Iterator[None]:
    """Turns whatever the block raises into one sentence about `path`; errors of this project pass as they are.

    `what` is the description that the file does not meet, such as `a readable PLY cloud`; `kind` is raised.
    """
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit, SubterraError):
        raise
    except BaseException as error:  # libraries raise anything on damage; a panic in Rust is no `Exception`
        raise kind(f"{path}: not {what} ({cause(error)})") from error


BATCH = 500_000  # points of a chunk: 12 MB of coordinates


@dataclass(frozen=True)
class CloudSource:
    """A cloud that has been opened but not read."""

    format: str  # With its version, for the manifest
    # Starts reading: x, y, z as stored, float64, of bounded size; a fourth column is the intensity
    chunks: Callable[[], Iterator[Float[np.ndarray, "n k"]]]
    # Points from all over the file, or corners of its box, by which a unit is found
    sample: Float[np.ndarray, "k 3"]
    unit: str | None = None  # `m`, `mm` or a kind of foot, where the format or a header says so
    count: int | None = None  # Points in all, where the file knows
    crs: str | None = None  # Coordinate reference system, as the file has it
    # Points that `chunks` has left out so far, by why: withheld, noise, or no return
    left_out: Counter[str] = field(default_factory=Counter)


INTENSITIES = ("intensity", "reflectivity", "reflectance", "scalar_intensity")  # names of one field


def find_names(names: Sequence[str]) -> list[str]:
    """Return the names of x, y, z and any intensity, in whatever case; raises `ValueError` without one of xyz."""
    known = {name.lower(): name for name in reversed(names)}
    if missing := [name for name in "xyz" if name not in known]:
        raise ValueError(f"it has no field {', '.join(missing)}")
    return [known[name] for name in "xyz"] + [known[name] for name in INTENSITIES if name in known][:1]


def stack_points(records: np.ndarray) -> Float[np.ndarray, "n k"]:
    """Return x, y, z and any intensity of records as float64; raises `ValueError` where a coordinate is missing."""
    names = find_names(records.dtype.names or ())
    with np.errstate(invalid="ignore"):  # bit patterns that are no number; they are dropped later
        return np.stack([records[name] for name in names], axis=1).astype(np.float64)


def source_from_records(format: str, records: np.ndarray) -> CloudSource:
    """Return a source over records in memory or mapped from the file."""

    def chunks() -> Iterator[np.ndarray]:
        for start in range(0, len(records), BATCH):
            yield stack_points(records[start : start + BATCH])

    sample = stack_points(records[:: max(len(records) // 2000, 1)])[:, :3]
    return CloudSource(format, chunks, sample, count=len(records))


_TEXT_BLOCK = 1 << 22  # bytes


@dataclass(frozen=True)
class Lines:
    """The lines of a text file that hold numbers."""

    path: Path  # The file
    columns: tuple[int, ...]  # Columns to read, in this order
    delimiter: str | None = None  # Delimiter of the columns; `None` for any white space
    start: int = 0  # Byte of the first line of numbers
    line: int = 1  # Its number, from 1, for messages
    count: int | None = None  # Lines to read; all where `None`
    decimal_comma: bool = False  # True where `1,5` means one and a half
    counted: bool = False  # True where a line of one number may stand before each part, as in PTS

    def rows(self) -> Iterator[Float[np.ndarray, "n k"]]:
        """Yields the columns as numbers, block by block; raises `ValueError`, which names the line at fault."""
        line, left = self.line, self.count
        with self.path.open("rb") as file:
            file.seek(self.start)
            rest, last = b"", False
            while not last and left != 0:
                block = file.read(_TEXT_BLOCK)
                last = not block
                whole, _, rest = (rest, b"", b"") if last else (rest + block).rpartition(b"\n")
                breaks = whole.count(b"\n") + 1 if whole else 0
                if len(rest) > _TEXT_BLOCK:
                    raise ValueError(f"line {line + breaks} does not end")
                if whole.strip():
                    rows = self.parse(whole, line, left)
                    left = None if left is None else left - len(rows)
                    yield rows
                line += breaks
        if left:
            raise ValueError(f"it ends after {(self.count or 0) - left} of {self.count} points")

    def parse(self, block: bytes, first: int, limit: int | None = None) -> Float[np.ndarray, "n k"]:
        """Return the columns of a block of whole lines, at most `limit` rows; `first` is the number of its first line.

        Raises `ValueError`, which names the line that does not hold them.
        """
        lines = block.decode("utf-8", "replace").splitlines()
        if self.counted:
            lines = ["" if len(line.split()) == 1 else line for line in lines]
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
        """Return the line that is at fault: the one-line parser is asked again, so that it agrees with itself."""
        for index, line in enumerate(lines):
            try:
                if line.strip():
                    np.loadtxt([line], delimiter=self.delimiter, usecols=self.columns, ndmin=2, comments="#")
            except ValueError:
                shown = line if len(line) <= 60 else line[:60] + "…"
                return f"line {first + index} has no numbers in columns {[c + 1 for c in self.columns]}: {shown!r}"
        return None


def source_from_text(format: str, path: Path, names: list[str], start: int, line: int, count: int) -> CloudSource:
    """Return a source over `count` lines with a number for each of `names`, from a byte on; `line` is its number."""
    text = Lines(path, tuple(names.index(name) for name in find_names(names)), start=start, line=line, count=count)
    none = np.empty((0, 3))
    return CloudSource(format, text.rows, next(text.rows(), none)[:, :3] if count else none)


# Metres of each. Source: NIST SP 811, B.6: the international foot, and the US survey foot of 1200/3937 m.
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "us-ft": 1200 / 3937}
UNIT_NAMES = "m, cm, mm, ft or us-ft"
_AXES = re.compile(r"(-?[xyz])(-?[xyz])(-?[xyz])")
# The least extent of a tunnel's box is a height: at most some 100 m in m, at least some 1000 in mm.
_MM_FROM = 500.0
_NOT_SURELY_M = 50.0  # least extent from which the heights of columns are asked
_CM_FROM, _MM_HEIGHT_FROM = 50.0, 1600.0  # heights of columns: tunnels are some 5 m high, 500 cm or 5000 mm
_IN_COLUMN = 60  # points
_OTHER_UNIT = 5.0  # ratio from which a flag's unit is not the one detected: feet look like metres
_LYING = 3.0  # a tunnel longer along "up" than this many times both other extents is not z up
_LYING_LENGTH = 30.0  # m
_Y_UP = "x-zy"


@dataclass(frozen=True)
class Frame:
    """Conversion of stored coordinates to metres with z up."""

    unit: str  # A key of `UNITS`
    axes: str  # Stored axes that point along x, y and z
    # Both, and how each was found, for people and the manifest; `unit_doubt` where a flag's unit is not what it looks
    facts: dict[str, str]

    def apply(self, points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Return stored coordinates in m, z up; further columns stay as they are."""
        order, signs = _parse_axes(self.axes)
        return np.hstack([points[:, order] * (signs * UNITS[self.unit]), points[:, 3:]])


def needs_local_points(source: CloudSource) -> bool:
    """Return whether points that lie close together must be read before the unit of a cloud is known."""
    if source.unit not in (None, "m"):
        return False
    finite = source.sample[np.isfinite(source.sample).all(axis=1)]
    return len(finite) < 2 or float(np.ptp(finite, axis=0).min()) > _NOT_SURELY_M


def column_height(points: Float[np.ndarray, "n 3"]) -> float | None:
    """Return the median height of narrow upright columns of points, as stored; `None` for too few points.

    It is near the height of a tunnel whatever its length and grade.
    """
    if len(points) < 20 * _IN_COLUMN:
        return None
    plan = points[:, :2] - points[:, :2].min(axis=0)
    size = float(plan.max())
    for _ in range(16):
        cell = np.floor(plan / max(size, 1e-9)).astype(np.int64)
        key = cell[:, 0] * (1 << 31) + cell[:, 1]
        order = np.lexsort((points[:, 2], key))
        starts = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) != 0]))
        counts = np.diff(np.append(starts, len(key)))
        if np.median(np.repeat(counts, counts)) <= _IN_COLUMN:
            break
        size /= 2
    full = counts >= _IN_COLUMN // 3
    if not full.any():
        return None
    low, high = (order[starts[full] + (fraction * (counts[full] - 1)).astype(np.intp)] for fraction in (0.05, 0.95))
    return float(np.median(points[high, 2] - points[low, 2]))


def _detect_unit(least: float, height: float | None) -> str:
    """Return `m`, `cm` or `mm` by the least extent of a cloud and the height of its columns, as stored."""
    if least <= (_MM_FROM if height is None else _NOT_SURELY_M):
        return "m"
    if height is None:
        return "mm"
    return "m" if height < _CM_FROM else "cm" if height < _MM_HEIGHT_FROM else "mm"


def choose_frame(
    sample: np.ndarray, declared: str | None, unit: str | None, axes: str | None, local: np.ndarray | None = None
) -> Frame:
    """Return the frame of a cloud; flags (`unit`, `axes`) come before declarations, declarations before detection.

    `sample` holds points from all over the cloud, as stored; few or none where the file declares the unit. `local`
    holds points that lie close together, which tell cm from mm; a declaration of metres that would make a tunnel
    over 500 m high and wide is not believed. Raises `ValueError` for a flag that is no unit or no order of axes,
    and where the file declares another unit.
    """
    if unit is not None and unit not in UNITS:
        raise ValueError(f"unit {unit!r} is none of {UNIT_NAMES}")
    if unit is None and declared not in (None, *UNITS):
        raise ValueError(f"its coordinates are in {declared}, not in {UNIT_NAMES}; --unit overrides what it says")
    if axes is not None:
        _parse_axes(axes)
    finite = sample[np.isfinite(sample).all(axis=1)]
    extent = np.zeros(3)
    if len(finite):
        low, high = np.percentile(finite, [1, 99], axis=0) if len(finite) > 2 else (finite.min(0), finite.max(0))
        extent = high - low
    detected = _detect_unit(float(extent.min()), None if local is None else column_height(local))
    absurd = declared == "m" and detected != "m" and extent.min() > _MM_FROM
    chosen = unit or (detected if absurd else declared) or detected
    how = "by flag" if unit else "declared" if declared else f"detected: least extent {extent.min():.4g}"
    if absurd and not unit:
        how = f"detected: declared m, but its least extent is {extent.min():.4g}"
    metres = extent * UNITS[chosen]
    lying = metres[2] > max(_LYING * metres[:2].max(), _LYING_LENGTH)
    order = axes or (_Y_UP if lying else "xyz")
    why = "by flag" if axes else "detected: longest along z, so y is taken as up" if lying else "by default, z up"
    if np.linalg.det(np.eye(3)[_parse_axes(order)[0]] * _parse_axes(order)[1][:, None]) < 0:
        why += ", mirrored"
    facts = {"unit": f"{chosen} ({how})", "axes": f"{order} ({why})"}
    if unit and len(finite) and not 1 / _OTHER_UNIT < UNITS[unit] / UNITS[detected] < _OTHER_UNIT:
        facts["unit_doubt"] = (
            f"--unit {unit}, but with a least extent of {extent.min():.4g} its points look like {detected}"
        )
    return Frame(chosen, order, facts)


def _parse_axes(axes: str) -> tuple[list[int], np.ndarray]:
    match = _AXES.fullmatch(axes)
    letters = [part[-1] for part in match.groups()] if match else []
    if match is None or len(set(letters)) != 3:
        raise ValueError(f"axes {axes!r} are not x, y and z in some order, each with or without a minus (xyz, -yxz, …)")
    return ["xyz".index(letter) for letter in letters], np.array([-1.0 if p[0] == "-" else 1.0 for p in match.groups()])
