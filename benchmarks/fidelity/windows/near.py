"""Windows near a change alone: their values are those of the whole tunnel, at a fraction of the time.

A local fault leaves the rest of the tunnel exactly as it is, and with it all windows that do not overlap it. Left out
is `hand`, whose windows of 30 m tell left from right.
"""

from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case, Near, kept_with
from benchmarks.fidelity.controls.local import Ground
from benchmarks.fidelity.derive.beams import Returns, observed_extent, returns, sensor_path
from benchmarks.fidelity.derive.curve import Curve, truth_curve
from benchmarks.fidelity.windows import track
from benchmarks.fidelity.windows.deviation import CELL, FINE, SECTORS, Frame, Relief, hold_frame, truth_relief
from benchmarks.fidelity.windows.judge import Worst
from benchmarks.fidelity.windows.measures import LONG, MEASURES, STANDARD_SENSOR, STEP, limits, sensor_of, sources
from benchmarks.fidelity.windows.shift import REACH

_SLACK = 1.0  # m: stations of one curve are not quite those of another
_WALLS = 8.0  # m from the axis to what the surfaces of a stretch lie within
_HAIR = 1e-6  # m, so that a whole number of cells does not come out one less
_LAST = ("shift",)  # measures that take longest
_WIDE = "hand"


class Nearby:
    """A case whose candidate has been judged, ready for windows near one change after the other.

    Attributes:
        case: The case of the candidate as it is.
        ground: Its ground of faults.
        known: Windows that were beyond their limits from the start, `(id, source)`.
    """

    def __init__(self, case: Case, ground: Ground, before: list[Worst]) -> None:
        self.case, self.ground = case, ground
        self.known = {(one.id, one.source) for one in before if one.beyond}
        readers = [track.true_bed_error, track.true_pocket_error] if case.truth is not None else []
        if case.hold is not None:
            readers += [track.seen_rail_side, track.seen_rail_height, track.seen_bed_error]
        profiles = {read.__name__: read(case).station for read in readers}
        self._ends = {name: (float(at.min()), float(at.max())) for name, at in profiles.items() if len(at)}

    def first_beyond(self, spoilt: Candidate, start: float, end: float) -> str:
        """Return the first window found beyond its limit that was not before, `id.source`; empty for none.

        Args:
            spoilt: The candidate with a change.
            start: Station of the candidate where the change begins, m.
            end: Station where it ends, m.
        """
        near = replace(self._cut(start, end), candidate=spoilt)
        sensor = (sensor_of(near.hold.sensor) if near.hold is not None else "") or STANDARD_SENSOR
        ordered = sorted((one for one in MEASURES if one.id != _WIDE), key=lambda one: one.id in _LAST)
        for source in reversed(sources(near)):
            for one in ordered:
                limit = limits(sensor)[f"{one.id}.{source}"]
                if limit is None or (one.id, source) in self.known:
                    continue
                try:
                    value = one.compute(near, source).value
                except Exception:  # a spoilt candidate may break any library, which is beyond the limit, as everywhere
                    return f"{one.id}.{source}"
                if np.isfinite(value).any() and float(np.nanmax(value)) > limit:
                    return f"{one.id}.{source}"
        return ""

    def _cut(self, start: float, end: float) -> Case:
        """Return the case with what its references show of the windows that overlap a stretch."""
        case, line = self.case, self.ground.line
        ends = line.point(np.array([[start, 0.0, 0.0], [end, 0.0, 0.0]]))
        path = truth = (0.0, 0.0)
        hold, real, corners = case.hold, case.truth, [ends]
        if hold is not None:
            frame = hold_frame(case)
            low, high, path = _stretch(sensor_path(case), ends, frame.low, frame.rows * CELL)
            high = high + _HAIR if np.isfinite(path[1]) else frame.high
            corners.append(sensor_path(case).point(_along(low, high)))
            rows = (frame.local[:, 0] >= low) & (frame.local[:, 0] < high)
            few = Returns(*(getattr(returns(case), one.name)[rows] for one in fields(Returns)))
            cell = np.where(frame.cell >= 0, frame.cell - round((low - frame.low) / CELL) * SECTORS, -1)[rows]
            part = Frame(frame.local[rows], frame.angle[rows], frame.middle, low, high, cell)
            kept = kept_with(case, hold, {returns: few, hold_frame: part, observed_extent: (low, high)})
            hold = replace(hold, cache=kept)
        if real is not None:
            relief = truth_relief(case)
            begin = float(relief.station[0]) - FINE / 2
            length = len(relief.station) // round(CELL / FINE) * CELL
            low, high, truth = _stretch(truth_curve(case), ends, begin, length)
            corners.append(truth_curve(case).point(_along(low, high)))
            last = round((high - begin) / FINE) if np.isfinite(truth[1]) else len(relief.station)
            steps = slice(round((low - begin) / FINE), last)
            shown = Relief(relief.station[steps], relief.radius[steps])
            real = replace(real, cache=kept_with(case, real, {truth_relief: shown}))
        box = np.concatenate(corners)
        box = np.array([box.min(axis=0) - _WALLS, box.max(axis=0) + _WALLS])
        return replace(case, hold=hold, truth=real, near=Near(path, truth, self._ends, box), cache={})


def _along(low: float, high: float) -> Float[np.ndarray, "k 3"]:
    station = np.arange(low, high + 1.0, 1.0)
    return np.column_stack([station, np.zeros((len(station), 2))])


def _stretch(
    curve: Curve, ends: Float[np.ndarray, "2 3"], first: float, length: float
) -> tuple[float, float, tuple[float, float]]:
    """Return ends of a stretch of a map, on its own grid of windows, and what windows must lie between, m.

    The stretch reaches beyond the windows by as much as their relief is shifted; not beyond the map.
    """
    at = np.sort(curve.local(ends)[:, 0])
    reach = LONG + REACH + _SLACK
    low = first + max(np.floor((at[0] - reach - first) / STEP), 0.0) * STEP
    high = min(first + np.ceil((at[1] + reach - first) / STEP) * STEP, first + length)
    inner = (low + REACH if low > first else -np.inf, high - REACH if high < first + length else np.inf)
    return float(low), float(high), (float(inner[0]), float(inner[1]))
