"""Verdict on one build: right, warned of, refused, or wrong without a word."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from benchmarks.dirty.truth import Truth
from scene.judging.codes import Code

CLOSE = 0.03  # m: sizes and the mean distance of walls may be off by this
NEAR_SHARE = 0.97  # of the wall points must be met within 10 cm
END = 0.15  # m that a bore may run on beyond its lining
COVERED = 0.97  # of the judged span must be built
GAUGE = 0.005  # m
SLEEPER_F1 = 0.9
_PROUD = 0.05  # m: sleepers that stand out so far must be seen
_TROUBLE_SLACK, _FAULT_SLACK = 4.0, 2.0  # m between the stretch of a warning and a trouble, or a fault
_PATH = re.compile(r"\S*/\S+")  # the name of a file may hold the very word that is looked for

RIGHT, WARNED, VAGUE, SILENT = "right", "warned", "vague", "SILENT"
REFUSED, MISLED, FAILED = "refused", "MISLED", "FAILED"  # with a true reason; with another; not by a sentence

_FRAME = (Code.AXES, Code.LYING, Code.SIZE, Code.CALIBRATION)  # what is wrong with the whole cloud
_BLURRED = (Code.POSES, Code.CLOCK, Code.DOUBLED, Code.ROUNDED)
_SHAPE = (*_FRAME, *_BLURRED, Code.LEAN, Code.DENT, Code.UNSEEN, Code.PLACE, Code.UNEXPLAINED, Code.CUT)
_ENDS = (*_FRAME, Code.LENGTH, Code.BEYOND, Code.CUT, Code.CUT_SHORT)
# The codes of the warnings that speak of each kind of fault.
TOLD_BY: dict[str, tuple[Code, ...]] = {
    **dict.fromkeys(("walls", "width", "height", "floor", "aside"), _SHAPE),
    **dict.fromkeys(("too long", "too short"), _ENDS),
    "sleepers": (*_FRAME, *_BLURRED, Code.SLEEPERS, Code.RAILS),
    "gauge": (*_BLURRED, Code.SIZE),
    **dict.fromkeys(("rings", "pockets"), (Code.BY_STANDARD,)),
}


@dataclass(frozen=True)
class Fault:
    """Faults of a built scene beyond the tolerances."""

    kind: str  # A key of `TOLD_BY`
    text: str  # It in a few words
    place: float = math.nan  # True station, m; NaN where it has none


def list_faults(row: dict[str, Any], truth: Truth) -> list[Fault]:
    """Returns the faults of a built scene.

    Args:
        row: Figures as `judge_scene` returns them.
        truth: Truth of the case.
    """
    faults = []
    if _beyond(row.get("wall_mean"), CLOSE):
        faults.append(Fault("walls", f"walls {100 * row['wall_mean']:.1f} cm in the mean"))
    if row.get("wall_near", 1.0) < NEAR_SHARE:
        faults.append(Fault("walls", f"{100 * row['wall_near']:.1f} % within 10 cm"))
    for name in ("width", "height", "floor", "aside"):
        whole = name in truth.bulge
        key, place = (name, math.nan) if whole else (f"{name}_worst", row.get(f"{name}_worst_at", math.nan))
        if _beyond(row.get(key), CLOSE):
            at = "" if whole else f" at {place:.0f} m"
            faults.append(Fault(name, f"{name} {100 * row[key]:+.0f} cm{at}", place))
    if row.get("beyond", 0.0) > END:
        faults.append(Fault("too long", f"{row['beyond']:.2f} m too long"))
    if row.get("covered", 1.0) < COVERED:
        faults.append(Fault("too short", f"only {100 * row['covered']:.0f} % of the span built"))
    faults += _track_faults(row, truth)
    for name in ("rings", "pockets") if truth.plain else ():
        for how in ("measured", "by_standard"):
            if number := row.get(f"{name}_{how}"):
                faults.append(Fault(name, f"{number} {name} {how.replace('_', ' ')} that do not exist"))
    return faults


def _beyond(value: float | None, limit: float) -> bool:
    return value is not None and not math.isnan(value) and abs(value) > limit


def _track_faults(row: dict[str, Any], truth: Truth) -> list[Fault]:
    if truth.track == "none":
        return [Fault("sleepers", f"{row['sleepers']} sleepers where no track is")] if row.get("sleepers") else []
    faults = []
    if truth.track and truth.proud >= _PROUD:
        if not row.get("sleepers_seen"):
            faults.append(Fault("sleepers", "no sleeper seen"))
        if len(truth.sleepers) and row.get("sleeper_f1", 0.0) < SLEEPER_F1:
            faults.append(Fault("sleepers", f"sleeper F1 {row.get('sleeper_f1', 0.0):.2f}"))
    seen = row.get("gauge_seen")
    if truth.track and seen is not None and not math.isnan(truth.gauge) and abs(seen - truth.gauge) > GAUGE:
        faults.append(Fault("gauge", f"gauge {1000 * (seen - truth.gauge):+.0f} mm"))
    return faults


def judge_build(row: dict[str, Any], faults: Iterable[Fault], truth: Truth) -> str:
    """Returns the verdict on a build.

    A wrong scene counts as warned of where warnings speak of each fault, and of the cause where the truth asks for it.
    Warnings of other things leave it vague.

    Args:
        row: Its `status`, `message` and `warnings`; of a built scene `from`, `to` and `reversed` too.
        faults: Its faults.
        truth: Truth of the case.
    """
    if row["status"] not in (0, 2, 3):
        return FAILED
    if row["status"]:
        return REFUSED if _names_cause(_PATH.sub("", row["message"]), truth) else MISLED
    faults = list(faults)
    said = not (truth.must_say or truth.expect != "built") or _names_trouble(row, truth)
    if said and not untold_faults(row, faults, truth):
        return RIGHT if truth.expect == "built" and not faults else WARNED
    return VAGUE if row["warnings"] else SILENT


def untold_faults(row: dict[str, Any], faults: Iterable[Fault], truth: Truth) -> list[Fault]:
    """Returns the faults of which no warning speaks: none of a code for such a fault, at its place where both have one.

    The shape within a trouble that the truth knows is told where a warning names its cause and place.
    """
    trouble = bool(truth.cause) and not math.isnan(truth.trouble[0]) and _names_trouble(row, truth)

    def told(fault: Fault) -> bool:
        if trouble and TOLD_BY[fault.kind] is _SHAPE and _near(fault.place, *truth.trouble, _TROUBLE_SLACK):
            return True
        return any(one["code"] in TOLD_BY[fault.kind] and _near(fault.place, *_stretch(one, row), _FAULT_SLACK)
                   for one in row["warnings"])  # fmt: skip

    return [fault for fault in faults if not told(fault)]


def _names_trouble(row: dict[str, Any], truth: Truth) -> bool:
    """Tells whether a warning that names the true cause also names its place."""
    start, end = truth.trouble
    for one in row["warnings"]:
        low, high = _stretch(one, row)
        near = math.isnan(start) or (low - _TROUBLE_SLACK <= end and start <= high + _TROUBLE_SLACK)
        if near and _names_cause(one["text"], truth):
            return True
    return False


def _names_cause(text: str, truth: Truth) -> bool:
    """Tells whether a text has one of the words of the true cause; true where no cause is known."""
    return not truth.cause or any(word.casefold() in text.casefold() for word in truth.cause)


def _stretch(warning: dict[str, Any], row: dict[str, Any]) -> tuple[float, float]:
    """Returns the true stations of a warning, m; all where it has no place. A scene counts from its own start."""
    if warning.get("start") is None:
        return -math.inf, math.inf
    if row["reversed"]:
        return row["to"] - warning["end"], row["to"] - warning["start"]
    return row["from"] + warning["start"], row["from"] + warning["end"]


def _near(place: float, start: float, end: float, slack: float) -> bool:
    return math.isnan(place) or start - slack <= place <= end + slack
