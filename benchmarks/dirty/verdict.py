"""Verdict on one build: right, warned with place and cause, refused, or wrong without a word."""

import math
import re
from typing import Any

from benchmarks.dirty.truth import Truth

CLOSE = 0.03  # m: sizes and the mean distance of walls may be off by this
NEAR_SHARE = 0.97  # of the wall points must be met within 10 cm
END = 0.15  # m that a bore may run on beyond its lining
COVERED = 0.97  # of the judged span must be built
GAUGE = 0.005  # m
SLEEPER_F1 = 0.9
_PROUD = 0.05  # m: sleepers that stand out so far must be seen
_PLACE_SLACK = 4.0  # m between the place that a warning names and that of the trouble
_PATH = re.compile(r"\S*/\S+")  # the name of a file may hold the very word that is looked for
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?=\s*(?:m\b|\u2013|-|to\b|and\b))")

RIGHT, WARNED, VAGUE, SILENT = "right", "warned", "vague", "SILENT"
REFUSED, MISLED, FAILED = "refused", "MISLED", "FAILED"  # with a true reason; with another; not by a sentence


def list_faults(row: dict[str, Any], truth: Truth) -> list[str]:
    """Return what is wrong with a built scene by more than the tolerances, each in a few words."""
    faults = []
    if _beyond(row.get("wall_mean"), CLOSE):
        faults.append(f"walls {100 * row['wall_mean']:.1f} cm in the mean")
    if row.get("wall_near", 1.0) < NEAR_SHARE:
        faults.append(f"{100 * row['wall_near']:.1f} % within 10 cm")
    for name in ("width", "height", "floor", "aside"):
        key = name if name in truth.bulge else f"{name}_worst"
        if _beyond(row.get(key), CLOSE):
            place = "" if name in truth.bulge else f" at {row[f'{name}_worst_at']:.0f} m"
            faults.append(f"{name} {100 * row[key]:+.0f} cm{place}")
    if row.get("beyond", 0.0) > END:
        faults.append(f"{row['beyond']:.2f} m too long")
    if row.get("covered", 1.0) < COVERED:
        faults.append(f"only {100 * row['covered']:.0f} % of the span built")
    return faults + _track_faults(row, truth) + _lining_faults(row, truth)


def _beyond(value: float | None, limit: float) -> bool:
    """Return whether a known value is larger than a limit, in size."""
    return value is not None and not math.isnan(value) and abs(value) > limit


def _track_faults(row: dict[str, Any], truth: Truth) -> list[str]:
    if truth.track == "none":
        return [f"{row['sleepers']} sleepers where no track is"] if row.get("sleepers") else []
    if not truth.track:
        return []
    faults = []
    if truth.proud >= _PROUD and not row.get("sleepers_seen"):
        faults.append("no sleeper seen")
    if len(truth.sleepers) and truth.proud >= _PROUD and row.get("sleeper_f1", 0.0) < SLEEPER_F1:
        faults.append(f"sleeper F1 {row.get('sleeper_f1', 0.0):.2f}")
    seen = row.get("gauge_seen")
    if seen is not None and not math.isnan(truth.gauge) and abs(seen - truth.gauge) > GAUGE:
        faults.append(f"gauge {1000 * (seen - truth.gauge):+.0f} mm")
    return faults


def _lining_faults(row: dict[str, Any], truth: Truth) -> list[str]:
    if not truth.plain:
        return []
    names = [(name, how) for how in ("measured", "by_standard") for name in ("rings", "pockets")]
    return [
        f"{row[f'{name}_{how}']} {name} {how.replace('_', ' ')} that do not exist"
        for name, how in names
        if row.get(f"{name}_{how}")
    ]


def judge_row(row: dict[str, Any], truth: Truth) -> str:
    """Return the verdict on a row that has status, message, warnings and faults."""
    if row["status"] not in (0, 2, 3):
        return FAILED
    if row["status"]:
        return REFUSED if names_cause([_PATH.sub("", row["message"])], truth) else MISLED
    said = bool(row["warnings"]) and names_cause(row["warnings"], truth)
    if truth.expect == "built" and not row["faults"] and (said or not truth.must_say):
        return RIGHT
    if said and names_place(row["warnings"], truth):
        return WARNED
    return VAGUE if row["warnings"] else SILENT


def names_cause(sentences: list[str] | tuple[str, ...], truth: Truth) -> bool:
    """Return whether a sentence has one of the words of the true cause; true where no cause is known."""
    return not truth.cause or any(word.casefold() in text.casefold() for text in sentences for word in truth.cause)


def names_place(sentences: list[str] | tuple[str, ...], truth: Truth) -> bool:
    """Return whether a sentence names a station near the trouble; true where the trouble has no place."""
    start, end = truth.trouble
    if math.isnan(start):
        return True
    length = float(truth.station[-1])
    places = [float(number) for text in sentences for number in _NUMBER.findall(text)]
    # The builder may count from either end.
    either = [*places, *(length - place for place in places)]
    return any(start - _PLACE_SLACK <= place <= end + _PLACE_SLACK for place in either)
