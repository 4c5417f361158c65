"""The worst windows of a case, the reasons that they give, and the stated faults that they must notice."""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import candidate_curve
from benchmarks.fidelity.faults import put_in
from benchmarks.fidelity.faults.kinds import local_site, stated_faults
from benchmarks.fidelity.windows import measures


@dataclass(frozen=True)
class Worst:
    """The worst window of one measure."""

    id: str  # Measure
    words: str  # Measure for people
    source: measures.Source  # `recording` or `truth`
    unit: str  # Unit of value and limit
    value: float | None  # Value there; `None` where nothing could be judged
    limit: float  # Largest value that passes
    # start, end: Stations of the window on the candidate's centreline, m; `None` without a value
    start: float | None = None
    end: float | None = None
    where: str = ""  # Part of the section; empty for all of it
    judged: float = 0.0  # Share of the windows that have a value
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
    return [_worst(case, one, source) for source in measures.sources(case) for one in measures.MEASURES]


def _worst(case: Case, one: measures.Measure, source: measures.Source) -> Worst:
    topic = case.hold.sensor if source == "recording" and case.hold is not None else ""
    sensor = measures.sensor_of(topic) if topic else measures.STANDARD_SENSOR
    limit = measures.limits(sensor or measures.STANDARD_SENSOR)[f"{one.id}.{source}"]
    nothing = Worst(one.id, one.words, source, one.unit, None, one.gate)
    if limit is None:
        return nothing
    nothing = replace(nothing, limit=limit, foreign="" if sensor else topic)
    try:
        series = one.compute(case, source)
    except Exception as error:  # a corrupted candidate may break any library
        return replace(nothing, error=f"{type(error).__name__}: {error}"[:200])
    if not np.isfinite(series.value).any():
        return nothing
    k = int(np.nanargmax(series.value))
    start, end = stations_on_candidate(case, source, series, k)
    found: dict[str, Any] = {"value": float(series.value[k]), "where": series.where[k], "judged": series.judged}
    return replace(nothing, start=start, end=end, **found)


def stations_on_candidate(case: Case, source: measures.Source, series: measures.Series, k: int) -> tuple[float, float]:
    """Return start and end of a window as stations of the candidate's centreline, the smaller first, m."""
    one = measures.unrolled(case, source)
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
    if not measures.sources(case):
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
