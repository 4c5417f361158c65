"""Measures by window, which a mean hides: their limits, the worst windows, stated faults that must be noticed."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import candidate_curve, section_angles
from benchmarks.fidelity.faults import put_in
from benchmarks.fidelity.faults.kinds import local_site, stated_faults
from benchmarks.fidelity.registry import Samples, mean_absolute, rms
from benchmarks.fidelity.windows import deviation, track

LIMITS = Path(__file__).with_name("limits.json")
Source = Literal["recording", "truth"]
SHORT, LONG, HAND = 5.0, 10.0, 30.0  # m, lengths of the windows
STEP = 1.0  # m between the starts of windows
OFF_CELL = 0.05  # m; a cell of the surface that is farther off counts as off
PLACES = ("left wall", "left haunch", "crown", "right haunch", "right wall", "right foot", "floor", "left foot")
_LEAST_CELLS = 0.15  # fraction of a window's cells that must be known
_LEAST_SECTOR = 6  # known cells of a window that show a sector
_LEAST_BEAMS = 20
_HAIR = 1e-6  # m, more than places that are one differ by rounding
_FAINT = 0.0015  # m; where left and right of the candidate differ by less, no side is known


@dataclass(frozen=True)
class Series:
    """Values of one measure, window by window."""

    start: Float[np.ndarray, " n"]  # Starts of the windows along the source's own curve, m
    value: Float[np.ndarray, " n"]  # Values; larger is worse, NaN where too little is known
    where: tuple[str, ...]  # Part of the section that each value belongs to; empty for all of it
    window: float  # Length of the windows, m


@dataclass(frozen=True)
class Measure:
    """A measure by window."""

    id: str  # Name
    words: str  # Name for people
    unit: str  # `m` or `1`
    gate: float  # Largest limit, whatever calibration finds
    compute: Callable[[Case, Source], Series]  # Function from case and source to values


def unrolled(case: Case, source: Source) -> deviation.Unrolled:
    return deviation.hold_map(case) if source == "recording" else deviation.truth_map(case)


def _by_cells(statistic: Callable[[Float[np.ndarray, "k m"]], tuple[float, str]]) -> Callable[[Case, Source], Series]:
    def compute(case: Case, source: Source) -> Series:
        one, rows = unrolled(case, source), round(SHORT / deviation.CELL)
        last = max(len(one.offset) - rows, 0)  # one window where it is longer
        firsts = np.arange(0, last + 1, round(STEP / deviation.CELL))
        windows = [one.offset[row : row + rows] for row in firsts]
        found = [statistic(w) if np.isfinite(w).mean() >= _LEAST_CELLS else (np.nan, "") for w in windows]
        values, places = zip(*found, strict=True)
        return Series(one.low + firsts * deviation.CELL, np.asarray(values, float), places, SHORT)

    return compute


def _worst_spot(cells: np.ndarray) -> tuple[float, str]:
    worst = np.unravel_index(np.nanargmax(np.abs(cells)), cells.shape)
    octant = int(np.round(section_angles(deviation.SECTORS)[worst[1]] / (np.pi / 4))) % 8
    return abs(float(cells[worst])), PLACES[octant]


def _worst_sector(cells: np.ndarray) -> tuple[float, str]:
    octant = np.round(section_angles(deviation.SECTORS) / (np.pi / 4)).astype(int) % 8
    means = []
    for k in range(8):
        part = cells[:, octant == k]
        part = part[np.isfinite(part)]
        means.append(abs(float(part.mean())) if len(part) >= _LEAST_SECTOR else 0.0)
    worst = int(np.argmax(means))
    return means[worst], PLACES[worst]


def _moved(direction: Float[np.ndarray, " m"]) -> Callable[[np.ndarray], tuple[float, str]]:
    """Return the statistic that tells how far the whole section has moved along a direction."""

    def statistic(cells: np.ndarray) -> tuple[float, str]:
        by_sector = np.array([np.mean(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in cells.T])
        known = np.isfinite(by_sector)
        weight = (direction[known] ** 2).sum()
        if (direction[known] > 0.5).sum() < 3 or (direction[known] < -0.5).sum() < 3:
            return np.nan, ""
        return abs(float((by_sector[known] * direction[known]).sum() / weight)), ""

    return statistic


def _shift(case: Case, source: Source) -> Series:
    one = unrolled(case, source)
    length = len(one.offset) * deviation.CELL
    starts = one.low + np.arange(0.0, max(length - LONG, 0.0) + 1e-6, STEP)
    found = (deviation.hold_shift if source == "recording" else deviation.truth_shift)(case, starts, LONG)
    return Series(starts, np.abs(found), ("",) * len(starts), LONG)


def _hand(case: Case, source: Source) -> Series:
    one = unrolled(case, source)
    relief = deviation.relief_on_path(case) if source == "recording" else deviation.relief_on_truth(case)
    judged = deviation.relief_cells(relief)
    count = min(len(judged), len(one.radius))
    rows, step = min(round(HAND / deviation.CELL), count), round(HAND / 3 / deviation.CELL)
    firsts = np.arange(0, max(count - rows, 0) + 1, step)
    pairs = [deviation.handedness(one.radius[k : k + rows], judged[k : k + rows]) for k in firsts]
    values = [np.nan if size < _FAINT else 1.0 - agreement for agreement, size in pairs]
    starts = one.low + firsts * deviation.CELL
    return Series(starts, np.asarray(values, float), ("",) * len(starts), rows * deviation.CELL)


def _by_profile(
    true: Callable[[Case], Samples] | None,
    seen: Callable[[Case], Samples] | None,
    statistic: Callable[[np.ndarray], float],
    window: float,
    least: int = _LEAST_BEAMS,
) -> Callable[[Case, Source], Series]:
    def compute(case: Case, source: Source) -> Series:
        read = true if source == "truth" else seen
        profile = track.NOTHING if read is None else read(case)
        if not len(profile.station):
            return Series(np.empty(0), np.empty(0), (), window)
        low, high = float(profile.station.min()), float(profile.station.max())
        starts = low + np.arange(0.0, max(high - low - window, 0.0) + 1e-6, STEP)
        order = np.argsort(profile.station, kind="stable")
        # Windows begin and end on places of the profile itself: the first counts and the last does not.
        bounds = np.searchsorted(profile.station[order] + _HAIR, [starts, starts + window])
        values = [abs(statistic(profile.values[order[a:b]])) if b - a >= least else np.nan for a, b in bounds.T]
        return Series(starts, np.asarray(values, float), ("",) * len(starts), window)

    return compute


def _gauge_change(case: Case) -> Samples:
    profile = track.true_gauge_error(case)
    return Samples(profile.values - np.median(profile.values), profile.station) if len(profile.values) else profile


_ANGLE = section_angles(deviation.SECTORS)
MEASURES = tuple(Measure(*row) for row in (
    ("wall", "mean distance of the walls", "m", 0.05,
     _by_cells(lambda cells: (float(np.nanmean(np.abs(cells))), ""))),
    ("sector", "mean offset of one part of the section", "m", 0.08, _by_cells(_worst_sector)),
    ("aside", "section moved to one side", "m", 0.05, _by_cells(_moved(np.cos(_ANGLE)))),
    ("lift", "section moved up or down", "m", 0.05, _by_cells(_moved(np.sin(_ANGLE)))),
    ("cells", f"fraction of the surface more than {100 * OFF_CELL:g} cm off", "1", 0.2,
     _by_cells(lambda cells: (float(np.mean(np.abs(cells[np.isfinite(cells)]) > OFF_CELL)), ""))),
    ("spot", f"one spot of {deviation.CELL:g} m by {360 // deviation.SECTORS:d} degrees", "m", 0.3,
     _by_cells(_worst_spot)),
    ("shift", "relief of the walls moved along the tunnel", "m", 0.15, _shift),
    ("hand", "left and right exchanged (0 not, 2 mirrored)", "1", 1.2, _hand),
    ("gauge", "error of the gauge", "m", 0.006, _by_profile(track.true_gauge_error, None, np.mean, LONG, 8)),
    ("gauge_change", "gauge against that of the whole track", "m", 0.004,
     _by_profile(_gauge_change, None, np.mean, LONG, 8)),
    ("rail_aside", "track moved to one side", "m", 0.03,
     _by_profile(lambda case: track.true_rail_offsets(case)[0], track.seen_rail_side, np.median, SHORT, 8)),
    ("rail_height", "rails above or below their place", "m", 0.02,
     _by_profile(lambda case: track.true_rail_offsets(case)[1], track.seen_rail_height, np.median, SHORT, 8)),
    ("bed", "height of bed and sleepers, root mean square", "m", 0.05,
     _by_profile(track.true_bed_error, track.seen_bed_error, rms, SHORT, 15)),
    ("pockets", "mean error of the pockets' depth", "m", 0.06,
     _by_profile(track.true_pocket_error, None, mean_absolute, SHORT, 8)),
))  # fmt: skip


SENSORS = {"os1": ("ouster", "os1", "os_cloud"), "avia": ("livox",), "vlp16": ("velodyne", "vlp")}
STANDARD_SENSOR = "os1"  # of which the limits against the truth come, and those of a sensor that is none of `SENSORS`


def sensor_of(topic: str) -> str | None:
    """Return the LiDAR of `SENSORS` that a recording's topic names; `None` for another."""
    known = [sensor for sensor, words in SENSORS.items() if any(word in topic.lower() for word in words)]
    return known[0] if known else None


@cache
def limits(sensor: str = STANDARD_SENSOR) -> dict[str, float | None]:
    """Return the frozen limits by `id.source`; those that were not set with a sensor are the standard one's.

    `None` where windows in which nothing is wrong lie beyond the gate with this sensor: it cannot judge that measure.
    """
    frozen = json.loads(LIMITS.read_text())
    rows = frozen["limits"] | frozen["sensors"].get(sensor, {})
    return {
        f"{one.id}.{source}": rows.get(f"{one.id}.{source}", {}).get("limit", one.gate)
        for one in MEASURES
        for source in ("recording", "truth")
    }


def sources(case: Case) -> tuple[Source, ...]:
    both: tuple[tuple[Source, object], ...] = (("recording", case.hold), ("truth", case.truth))
    return tuple(name for name, reference in both if reference is not None)


# The worst windows, and the reasons that they give.


@dataclass(frozen=True)
class Worst:
    """The worst window of one measure."""

    id: str  # Measure
    words: str  # Measure for people
    source: Source  # `recording` or `truth`
    unit: str  # Unit of value and limit
    value: float | None  # Value there; `None` where nothing could be judged
    limit: float  # Largest value that passes
    # start, end: Stations of the window on the candidate's centreline, m; `None` without a value
    start: float | None = None
    end: float | None = None
    where: str = ""  # Part of the section; empty for all of it
    judged: float = 0.0  # Fraction of the windows that have a value
    error: str = ""  # Cause why there is no value, if the computation broke
    foreign: str = ""  # Topic of a recording by a sensor that the limit was not set with; empty otherwise

    @property
    def beyond(self) -> bool:
        """True where the window fails; a computation that broke on the candidate fails too."""
        return bool(self.error) or (self.value is not None and self.value > self.limit)

    def sentence(self) -> str:
        if self.error:
            return f"window {self.id} (against the {self.source}) could not be computed: {self.error}"
        assert self.value is not None
        factor, unit, digits = (100.0, " cm", 1) if self.unit == "m" else (1.0, "", 2)
        if self.id.startswith("gauge"):
            factor, unit = 1000.0, " mm"
        place = f" at the {self.where}" if self.where else ""
        return (
            f"window {self.id}: {self.words}{place} is {factor * self.value:.{digits}f}{unit} from station "
            f"{self.start:.0f} to {self.end:.0f} m against the {self.source}; {factor * self.limit:.{digits}f}{unit} "
            f"is the limit{f', which was not set with the sensor of {self.foreign}' if self.foreign else ''}"
        )


def worst_windows(case: Case) -> list[Worst]:
    """Return the worst window of every measure against every reference of the case; empty without a reference."""
    return [_worst(case, one, source) for source in sources(case) for one in MEASURES]


def _worst(case: Case, one: Measure, source: Source) -> Worst:
    topic = case.hold.sensor if source == "recording" and case.hold is not None else ""
    sensor = sensor_of(topic) if topic else STANDARD_SENSOR
    limit = limits(sensor or STANDARD_SENSOR)[f"{one.id}.{source}"]
    nothing = Worst(one.id, one.words, source, one.unit, None, one.gate)
    if limit is None:
        return nothing
    nothing = replace(nothing, limit=limit, foreign="" if sensor else topic)
    try:
        series = one.compute(case, source)
    except Exception as error:  # a corrupted candidate may break any library
        return replace(nothing, error=f"{type(error).__name__}: {error}"[:200])
    judged = np.isfinite(series.value)
    if not judged.any():
        return nothing
    k = int(np.nanargmax(series.value))
    start, end = stations_on_candidate(case, source, series, k)
    found: dict[str, Any] = {"value": float(series.value[k]), "where": series.where[k], "judged": float(judged.mean())}
    return replace(nothing, start=start, end=end, **found)


def stations_on_candidate(case: Case, source: Source, series: Series, k: int) -> tuple[float, float]:
    """Return start and end of a window as stations of the candidate's centreline, the smaller first, m."""
    one = unrolled(case, source)
    ends = np.array([one.place(series.start[k]), one.place(series.start[k] + series.window)])
    low, high = np.sort(candidate_curve(case).local(ends)[:, 0])
    return float(np.clip(low, 0.0, case.candidate.length)), float(np.clip(high, 0.0, case.candidate.length))


# Faults that are put in, and must be noticed, before a verdict may be PASS.


@dataclass(frozen=True)
class Noticed:
    """A stated fault, put into the candidate."""

    name: str  # Fault in words
    by: tuple[str, ...]  # Windows `id.source` that are beyond their limits with it and not without it
    # False where nothing at hand could show it: a gauge without a truth, a mirror where left is as right
    needed: bool = True


def notice_faults(case: Case, before: list[Worst]) -> list[Noticed]:
    """Puts the stated faults into the candidate, one at a time, and says which windows notice them."""
    if not sources(case):
        return []
    site, judged = local_site(case), {f"{one.id}.{one.source}" for one in before if one.value is not None}
    result = []
    for name, fault in stated_faults(case.candidate.length).items():
        if fault.kind in ("rails", "gauge") and not len(case.candidate.track.rail_mesh.faces):
            continue
        shows = {"gauge": ("gauge.truth",), "mirror": ("hand.truth", "hand.recording")}.get(fault.kind)
        needed = shows is None or bool(judged & set(shows))
        result.append(Noticed(name, noticed_by(put_in(site, fault), before), needed))
    return result


def noticed_by(corrupted: Case, before: list[Worst]) -> tuple[str, ...]:
    """Return the windows that are beyond their limits in a corrupted case and were not before, `id.source`."""
    known = {(one.id, one.source) for one in before if one.beyond}
    after = worst_windows(corrupted)
    return tuple(f"{one.id}.{one.source}" for one in after if one.beyond and (one.id, one.source) not in known)


@dataclass(frozen=True)
class Windows:
    """Result of the windows of a candidate."""

    worst: tuple[Worst, ...] = ()  # The worst window of each measure
    noticed: tuple[Noticed, ...] = ()  # The stated faults; empty where they were not put in

    def reasons(self) -> list[str]:
        """Return the reasons for FAIL, in sentences; empty for PASS."""
        beyond = [one.sentence() for one in self.worst if one.beyond]
        return beyond + [
            f"the windows would not notice this fault here: {one.name}"
            for one in self.noticed if one.needed and not one.by
        ]  # fmt: skip


def judge_windows(case: Case) -> Windows:
    """Return the worst windows of a case, and whether they notice the stated faults."""
    worst = worst_windows(case)
    return Windows(tuple(worst), tuple(notice_faults(case, worst)))


def dump_windows(found: Windows) -> dict[str, Any]:
    return {
        "worst": [asdict(one) | {"beyond": one.beyond} for one in found.worst],
        "faults": [asdict(one) for one in found.noticed],
    }


def load_windows(content: dict[str, Any]) -> Windows:
    worst = ({key: value for key, value in row.items() if key != "beyond"} for row in content["worst"])
    faults = ({**row, "by": tuple(row["by"])} for row in content["faults"])
    return Windows(tuple(Worst(**row) for row in worst), tuple(Noticed(**row) for row in faults))
