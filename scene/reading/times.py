"""When each point of a sweep was measured: decided once for a recording, from all of its headers and spans.

Drivers of LiDARs differ in the unit, the sign and the origin of their point times, and none of them says so. What a
recording itself tells is enough: times that grow from sweep to sweep as the headers do are absolute, of the headers'
clock or of another one; times that begin anew in each sweep count from the header, before it (VLP-16: its end) or after
it (Ouster, Livox: its start). The growth, or the span of a sweep against the time between two headers, gives the unit.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Float, Int, Shaped

_TIME_NAME = re.compile(r"(?:d?t|ts|.*time.*?|.*stamps?|.*offset(?=_))(?:_(ns|us|ms|s)(?:ecs?)?)?")
STATIC = "none: every sweep is taken as static"
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_LONGEST_SWEEP = 2.0  # s
_SAME_CLOCK = 10.0  # s between header and absolute point times
_FIRST_EPOCH = 1e8  # s; times since 1970 are larger, and nothing older than 1973 is a recording
_OVER_PERIOD, _UNSURE = 1.2, 5.0  # times the period: longest sweep; up to which a longer unit is not ruled out
_LEAST_SWEEP = 0.005  # of the period: a shorter sweep makes the unit unsure
_GROWS = 0.5  # of the span of a sweep, by which the times of the next one are later: they are absolute
_EVEN = 0.02  # s of spread about one offset between two clocks; with more the headers rule
_LEAP = 1.0  # s by which an offset changes at once where a clock begins anew
_FEWEST = 4  # sweeps between two such leaps, by the offset that they have in common
_WIDE = 1.5  # times the reach of a sweep from its middle: further is no time of that sweep
SHORT, WHOLE = 0.075, 0.1  # s: messages closer than that are parts of a sweep, or quick ones; what they are joined to
MOST_BAD = 0.05  # fraction of all points without a time of their sweep
_SAMPLE = 4000  # points of a sweep by which its span is found
_MOST, _AROUND = 0.85, 3.0  # part of the points that lie about the median; how much further a time of theirs may lie
_LONG = 0.95  # quantile of the spans of all sweeps that is the length of one: of some the first or last beams are lost
_COUNTER = 2.0**32  # values of a counter of 32 bits
_LIKE = 0.1  # of the spread that a fraction of a sweep has: times with less of it are alike
_FARTHEST = 1e7  # m; no sensor sees so far
_FLAG = tyro.conf.arg(prefix_name=False)


# Whole numbers since 1970 are in the unit that puts them after 1973.
_SINCE_1970 = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))


def seconds_in(value: float) -> float:
    """Return the unit of a time, s: 1, or less where the number is too large for seconds since 1970."""
    return next((scale for least, scale in _SINCE_1970 if value >= least), 1.0)


@dataclass(frozen=True)
class TimeConfig:
    """The user's word on the times of points; nothing overrules it."""

    # Unit of the times of points: s, ms, us or ns; none leaves them out, and every sweep is static.
    time_unit: Annotated[Literal["s", "ms", "us", "ns", "none"] | None, _FLAG] = None
    time_stamp: Annotated[Literal["start", "end"] | None, _FLAG] = None  # Part of a sweep that its header is of.


def time_field(names: Iterable[str]) -> tuple[str | None, str | None]:
    """Return which field holds the times of points, the shortest name that says time, and the unit that it ends in."""
    known = [(name, match[1]) for name in names if (match := _TIME_NAME.fullmatch(name.lower()))]
    return min(known, key=lambda pair: len(pair[0]), default=(None, None))


@dataclass(frozen=True)
class Scan:
    """A sweep in the sensor frame."""

    stamp: float  # Time of the sweep, s
    points: Float[np.ndarray, "n 3"]  # Returns at their own time, m
    times: Float[np.ndarray, " n"]  # Time of each return after `stamp`, s
    intensity: Float[np.ndarray, " n"] | None = None  # As the sensor scales it; `None` where it tells none

    def pick(self, count: int, rows: Int[np.ndarray, " k"] | None = None) -> "Scan":
        """Return at most `count` returns of all, or of some rows, evenly spread over them."""
        rows = np.arange(len(self.points)) if rows is None else rows
        rows = rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(np.intp)]
        return Scan(self.stamp, self.points[rows], self.times[rows])

    @property
    def end(self) -> float:
        """Time of the last return, s."""
        return self.stamp + float(self.times.max(initial=0.0))


@dataclass(frozen=True)
class RawScan:
    """A sweep as it is stored, less points that are no return."""

    stamp: float  # Of its header, s
    points: Float[np.ndarray, "n 3"]  # m
    values: Shaped[np.ndarray, " n"] | None = None  # Time of each point as stored; `None` where there are none
    name: str = ""  # Field of the times
    unit: str | None = None  # Their unit, where the format says so
    received: float = np.nan  # When it was recorded, s; NaN where nobody knows
    intensity: Shaped[np.ndarray, " n"] | None = None  # As the sensor scales it; `None` where it tells none


def make_scan(
    stamp: float,
    points: Float[np.ndarray, "n 3"],
    values: Shaped[np.ndarray, " n"] | None,
    name: str = "",
    intensity: Shaped[np.ndarray, " n"] | None = None,
) -> RawScan:
    """Return a sweep as a reader has it, less points at the origin (nothing came back), not finite or absurdly far.

    Args:
        stamp: Stamp of the message, s.
        points: Points in the sensor frame, m.
        values: Point times as stored, in whatever unit; `None` where there are none.
        name: Name of their field.
        intensity: Intensity of each; `None` where there is none.
    """
    good = (np.abs(points) < _FARTHEST).all(axis=1) & (points != 0).any(axis=1)
    values, intensity = (None if column is None else column[good] for column in (values, intensity))
    return RawScan(stamp, points[good], values, name, intensity=intensity)


@dataclass(frozen=True)
class Convention:
    """Meaning of the point times of one recording."""

    kind: Literal["static", "after", "same clock", "other clock"]
    words: str  # For people, with the evidence
    scale: float = 1.0  # s
    length: float = _LONGEST_SWEEP  # Of a sweep, as far as it met something, s
    reach: float = _LONGEST_SWEEP  # Of a sweep at most, s
    reference: Literal["start", "end"] | None = None  # Part of a sweep that its header is of, where somebody says so
    guessed: bool = False  # True where nothing tells whether a header is of the start or the end of its sweep
    # Of the headers' clock before the points', s: one for each time that the latter began anew; none where each header
    # tells its own
    offsets: tuple[float, ...] = ()
    by_receipt: bool = False  # True where the headers say nothing and the time of recording stands for them
    step: float = np.inf  # Usual time from one message to the next, s

    def apply(self, raw: RawScan) -> tuple[Scan, int]:
        """Return the sweep with its returns in the order of time, and the number left out for want of a time."""
        stamp = raw.received if self.by_receipt else raw.stamp
        if raw.values is None or self.kind == "static":
            return Scan(stamp, raw.points, np.zeros(len(raw.points)), raw.intensity), 0
        values, good = _unwrap(raw.values)
        if not good.any():
            return Scan(stamp, raw.points[:0], np.zeros(0)), len(good)
        good &= np.abs(values - np.median(values[good])) * self.scale <= _WIDE * self.reach
        start, times = self._place(stamp, values[good] * self.scale)
        rows = np.flatnonzero(good)
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            rows, times = rows[order], times[order]
        intensity = None if raw.intensity is None else raw.intensity[rows]
        return Scan(start, raw.points[rows], times, intensity), int((~good).sum())

    def _place(self, stamp: float, times: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        """Return the time from which a sweep is counted, and times after it, s."""
        low = float(times.min())
        begin = stamp - (self.length if self.reference == "end" else 0.0)
        if self.kind == "after":
            shift = min(low, 0.0)
            return (stamp + shift if self.reference is None else begin), times - shift
        times = times - low
        if self.kind == "same clock":
            return low, times
        start = min((low + offset for offset in self.offsets), key=lambda at: abs(at - begin), default=np.inf)
        return (start if abs(start - begin) < _LEAP else begin), times


def join_scans(parts: list[Scan]) -> Scan:
    """Return one sweep of several messages that follow one another."""
    if len(parts) == 1:
        return parts[0]
    times = np.concatenate([part.times + (part.stamp - parts[0].stamp) for part in parts])
    brightness = [part.intensity for part in parts if part.intensity is not None]
    intensity = np.concatenate(brightness) if len(brightness) == len(parts) else None
    return Scan(parts[0].stamp, np.concatenate([part.points for part in parts]), times, intensity)


def _unwrap(values: Shaped[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return times as float64, and which are of the sweep: counters of 32 bits may pass their end within one.

    Values across that end that are alike are no sign of it: an underflow made them.
    """
    times = values.astype(np.float64)
    good = np.isfinite(times)
    if _counts_32(values) and len(values):
        turns = np.rint((times - np.median(times)) / _COUNTER)
        across = turns != 0.0
        if across.any() and times[across].std() > _LIKE * across.mean() * times[~across].std():
            times = times - _COUNTER * turns
        else:
            good = ~across
    return times, good


def _counts_32(values: Shaped[np.ndarray, " n"]) -> bool:
    return values.dtype.kind == "u" and values.dtype.itemsize == 4


@dataclass
class Spans:
    """Headers and times of all sweeps, gathered sweep by sweep."""

    name: str = ""
    unit: str | None = None
    counts: bool = False  # True where the times are a counter of 32 bits
    rows: list[tuple[float, float, float, float]] = field(default_factory=list)  # header, receipt, s; first, last value
    timed: list[int] = field(default_factory=list)  # Number of each sweep with times, among all
    points: int = 0  # In all of them

    def add(self, raw: RawScan) -> None:
        low = high = np.nan
        if raw.values is not None and len(raw.values):
            values, good = _unwrap(raw.values[:: max(1, len(raw.values) // _SAMPLE)])
            if good.any():
                apart = np.abs(values[good] - np.median(values[good]))
                inside = values[good][apart <= _AROUND * np.quantile(apart, _MOST)]
                low, high = float(inside.min()), float(inside.max())
            self.name, self.unit = self.name or raw.name, self.unit or raw.unit
            self.counts = _counts_32(raw.values)
            self.timed.append(len(self.rows))
        self.rows.append((raw.stamp, raw.received, low, high))
        self.points += len(raw.points)

    def decide(self, given: TimeConfig, why: str = "by flag") -> Convention:
        """Return what the times mean; raises `ValueError` where they fit nothing, or two readings alike.

        `why` says where `given` is from.
        """
        table = np.array(self.rows).reshape(-1, 4)
        by_receipt = _headers_repeat(table)
        stamp = table[:, 1] if by_receipt else table[:, 0]
        note = "; headers repeat, so the time of recording stands for them" if by_receipt else ""
        rows = np.array(self.timed, np.intp)
        rows = rows[np.isfinite(table[rows, 2])]
        if not len(rows) or given.time_unit == "none":
            return Convention("static", STATIC + note, by_receipt=by_receipt)
        stamp, low, high = stamp[rows], table[rows, 2], table[rows, 3]
        spans = high - low
        span = float(np.median(spans))
        if span == 0.0 or np.mean(spans == 0.0) > 0.5:
            which = "0 throughout" if not np.abs(high).max() else "one value in each sweep"
            return Convention("static", f"`{self.name}` is {which}: every sweep is taken as static{note}",
                              by_receipt=by_receipt)  # fmt: skip
        decide = self._decide_absolute if _is_absolute(stamp, low, span) else self._decide_relative
        found = decide(stamp, low, high, given)
        by = f" ({why})" if given.time_unit or given.time_stamp else ""
        length = max(float(np.quantile(spans, _LONG)) * found.scale, 1e-9)
        reach = max(length, float(np.fmin(_usual_step(stamp), _LONGEST_SWEEP)))
        step = _usual_step(stamp)
        joined = "; they are put together to sweeps of 0.1 s" if step < SHORT else ""
        words = found.words + by + joined + note
        return replace(found, words=words, by_receipt=by_receipt, length=length, reach=reach, step=step)

    def _decide_relative(self, stamp: np.ndarray, low: np.ndarray, high: np.ndarray, given: TimeConfig) -> Convention:
        span, period = float(np.median(high - low)), _usual_step(stamp)
        unit = given.time_unit or self.unit
        unit = unit or self._unit_of_span(span, float(np.median(np.maximum(high, -low))), period)
        scale = _UNITS[unit]
        side, guessed = "after the stamp (its start)", self.unit is None and given.time_stamp is None
        if float(np.median(-low)) > float(np.median(high)):
            side, guessed = "before the stamp (its end)", False
        if given.time_stamp is not None:
            side = f"from its start; the stamp is its {given.time_stamp}"
        evidence = f"; sweeps of {span * scale:.3g} s" + (f", {period:.3g} s apart" if np.isfinite(period) else "")
        words = f"`{self.name}`, {_shown(unit)} {side}{evidence}"
        return Convention("after", words, scale, reference=given.time_stamp, guessed=guessed)

    def _decide_absolute(self, stamp: np.ndarray, low: np.ndarray, high: np.ndarray, given: TimeConfig) -> Convention:
        unit = given.time_unit or self.unit or self._unit_of_growth(stamp, low)
        scale = _UNITS[unit]
        ahead = stamp - low * scale
        offset = float(np.median(ahead))
        length = f"sweeps of {np.median(high - low) * scale:.3g} s"
        if abs(offset) < _SAME_CLOCK and np.median(low) * scale > _FIRST_EPOCH and given.time_stamp is None:
            words = f"`{self.name}`, absolute, {_shown(unit)}; {length}, {offset:+.3g} s from the headers"
            return Convention("same clock", words, scale)
        offsets = _steady_offsets(ahead, _COUNTER * scale if self.counts else 0.0)
        reference = given.time_stamp or "start"
        rule = "each header tells when its sweep began"
        if offsets:
            rule = f"{offsets[0]:.9g} s behind the headers"
            rule += f", and otherwise {len(offsets) - 1} times, since it began anew" if len(offsets) > 1 else ""
        words = (
            f"`{self.name}`, absolute by another clock, {_shown(unit)}; {length}, {rule}; a header is taken for the "
            f"{reference} of its sweep"
        )
        late = float(np.quantile(high - low, _LONG)) * scale if reference == "end" else 0.0
        return Convention(
            "other clock", words, scale, reference=reference, guessed=given.time_stamp is None,
            offsets=tuple(one - late for one in offsets),
        )  # fmt: skip

    def _unit_of_span(self, span: float, largest: float, period: float) -> str:
        """Return the unit in which sweeps are as long as the time between two allows."""
        longest = min(_OVER_PERIOD * period, _LONGEST_SWEEP) if np.isfinite(period) else _LONGEST_SWEEP
        fits = [name for name, scale in _UNITS.items() if span * scale <= longest and largest * scale < 1e3]
        if not fits:
            raise ValueError(
                f"is a sweep whose `{self.name}` spans {span:.3g}: at most {_LONGEST_SWEEP:g} s are possible, in "
                "whatever unit; --time-unit none leaves the times out"
            )
        best = fits[0]
        longer = list(_UNITS)[list(_UNITS).index(best) - 1] if best != "s" else None
        fraction = span * _UNITS[best] / period if np.isfinite(period) else 1.0
        if longer and fraction < _LEAST_SWEEP and span * _UNITS[longer] < _UNSURE * period:
            raise ValueError(
                f"has times in `{self.name}` that fit two readings: {_shown(longer)}, sweeps of "
                f"{span * _UNITS[longer]:.3g} s, or {_shown(best)}, sweeps of {span * _UNITS[best]:.3g} s, "
                f"{period:.3g} s apart; --time-unit says which"
            )
        return best

    def _unit_of_growth(self, stamp: np.ndarray, low: np.ndarray) -> str:
        """Return the unit in which the times grow as the headers do; of few sweeps, that which makes them times."""
        steps = np.diff(stamp) > 0
        if steps.any():
            growth = float(np.median(np.diff(low)[steps] / np.diff(stamp)[steps]))
            for name, scale in _UNITS.items():
                if 0.5 < growth * scale < 2.0:
                    return name
            raise ValueError(
                f"has times in `{self.name}` that grow by {growth:.3g} in a second of the headers: by no unit; "
                "--time-unit says which, or none"
            )
        first, at = float(np.median(low)), float(np.median(stamp))
        near = [name for name, scale in _UNITS.items() if abs(first * scale - at) < _SAME_CLOCK]
        since = [name for name, scale in reversed(_UNITS.items()) if first * scale > _FIRST_EPOCH]
        return (near + since + ["s"])[0]


def _steady_offsets(ahead: Float[np.ndarray, " n"], turn: float) -> tuple[float, ...]:
    """Return the offsets that headers have from times, in their order, s; none where they wander or leap too often.

    A counter begins anew after `turn`, s: 0 where times are none. Other clocks do so when they are set, or start again.
    """
    turns = np.rint((ahead - ahead[0]) / turn) if turn else np.zeros(len(ahead))
    ahead = ahead - turn * turns
    parts = [part for part in np.split(ahead, np.flatnonzero(np.abs(np.diff(ahead)) > _LEAP) + 1)
             if len(part) >= min(_FEWEST, len(ahead))]  # fmt: skip
    middles = np.array([np.median(part) for part in parts])
    if not len(parts) or np.median(np.abs(ahead[:, None] - middles).min(axis=1)) >= _EVEN:
        return ()
    return tuple((middles[:, None] + turn * np.unique(turns)).ravel().tolist())


def _headers_repeat(table: Float[np.ndarray, "n 4"]) -> bool:
    """Return whether most headers have the time of the one before, though they were recorded one after another."""
    if len(table) < 3 or not np.isfinite(table[:, 1]).all():
        return False
    return bool(np.mean(np.diff(table[:, 0]) == 0) > 0.5 and np.mean(np.diff(table[:, 1]) > 0) > 0.9)


def _usual_step(stamp: Float[np.ndarray, " n"]) -> float:
    """Return the usual time between two headers, s; NaN for fewer than three."""
    steps = np.diff(stamp)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) > 1 else np.nan


def _is_absolute(stamp: np.ndarray, low: np.ndarray, span: float) -> bool:
    """Return whether times go on from sweep to sweep; of a single sweep, whether they are far above their span."""
    if len(low) > 1:
        return bool(np.median(np.diff(low)) > _GROWS * span)
    scales = np.array(list(_UNITS.values()))
    near = (np.abs(low[0] * scales - stamp[0]) < _SAME_CLOCK) & (low[0] * scales > _FIRST_EPOCH)
    return bool(near.any() or low[0] > _FIRST_EPOCH)


def _shown(unit: str) -> str:
    return "µs" if unit == "us" else unit
