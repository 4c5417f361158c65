"""Verdict on one build: right, warned with place and cause, refused, or wrong without a word."""

import math
import re
from dataclasses import dataclass
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
_FAULT_SLACK = 2.0  # m between the stretch that a warning names and the place of a fault
_FAULT_PLACE = re.compile(r" at (-?\d+) m$")
_STATION = r"(-?\d+(?:\.\d+)?)"
_RANGE = re.compile(rf"from (?:station )?{_STATION} to {_STATION} m\b|\bat {_STATION} m\b")
_GUESS = re.compile(r"(?:inside it|behind it|looks like)\b.*")
_AMOUNT = re.compile(r"([-+]?\d+(?:\.\d+)?) (m|cm|mm)\b")
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_SHAPE = r"^walls |within 10 cm|^width|^height|^floor|^aside"
_SLEEPERS = "no sleeper seen|sleeper F1"


@dataclass(frozen=True)
class Spoiler:
    """A cause that a warning may name without a place, and the faults which it can explain."""

    words: str  # What the warning says; a number in it is how much is off
    faults: str  # Beginnings of the faults
    unit: float = math.inf  # m, of that number
    times: float = 1.0  # of it, up to which a fault may go

    def named(self, warning: str) -> re.Match[str] | None:
        """Return the place in a warning where it names this cause."""
        return re.search(self.words, warning, re.IGNORECASE)

    def explains(self, warning: str, fault: str) -> bool:
        """Return whether a warning is of this cause, and a fault of its kind and no larger than it can make one."""
        found = self.named(warning)
        if found is None or re.search(self.faults, fault) is None:
            return False
        amount = _AMOUNT.search(fault)
        if amount is None or math.isinf(self.unit):
            return True
        return abs(float(amount[1])) * _METRES[amount[2]] <= self.times * self.unit * float(found[1])


_SPOILERS = (
    Spoiler(r"is z up|z is not up", rf"{_SHAPE}|too long|span built|{_SLEEPERS}"),
    Spoiler(r"floor and walls lean together by (\d+(?:\.\d+)?)°", _SHAPE, math.radians(1.0), 5.0),  # 5 m off the axis
    Spoiler(r"--unit|was its unit read", rf"{_SHAPE}|too long|span built|{_SLEEPERS}|gauge"),
    Spoiler(r"without --calibration", rf"{_SHAPE}|too long|sleeper F1"),
    # A clock, a mount or an order that is named tells what to mend; a blur alone, how far walls may be off.
    Spoiler(r"poses blur .*(?:are thin|order w, x, y, z)", rf"{_SHAPE}|{_SLEEPERS}|gauge"),
    Spoiler(r"poses blur .*?(\d+) mm thick", rf"{_SHAPE}|{_SLEEPERS}|gauge", 0.001, 3.0),
    Spoiler(r"wall shows twice, up to (\d+) cm", rf"{_SHAPE}|{_SLEEPERS}|gauge", 0.01, 2.0),
    Spoiler(r"rounded to (\d+(?:\.\d+)?) cm", rf"{_SHAPE}|{_SLEEPERS}|gauge", 0.01, 2.0),
    Spoiler(r"nothing measured the length", r"too long|span built"),
)
_WALL_WORDS = r"left wall|right wall|crown|all around|branch|opens into"
# What a fault begins with, and the words of the warnings that are of it.
_TOLD_BY = tuple(
    (re.compile(fault), re.compile(words))
    for fault, words in (
        (r"^walls |within 10 cm", rf"{_WALL_WORDS}|floor|further than 10 cm"),
        (r"^width|^aside", _WALL_WORDS),
        (r"^height", "crown|floor|all around"),
        (r"^floor", "floor|all around"),
        ("too long", "mouth|portal|beyond the ends|end of the bore|ends? of the lining"),
        ("of the span built", "cut away|cut at|left out|beyond the ends|gap"),
        ("sleeper", "sleeper|no rails|track"),
        ("gauge", "gauge"),
        ("rings", "rings"),
        ("pockets", "pockets"),
    )
)

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
    """Return the verdict on a row that has status, message, warnings and faults.

    A wrong scene counts as warned where each of its faults is told (see `untold_faults`), and the cause too where the
    truth asks for it. Warnings of other things leave it vague.
    """
    if row["status"] not in (0, 2, 3):
        return FAILED
    if row["status"]:
        return REFUSED if names_cause([_PATH.sub("", row["message"])], truth) else MISLED
    asked = truth.must_say or truth.expect != "built"
    said = not asked or _names_trouble(row["warnings"], truth)
    untold = untold_faults(row, truth)
    if said and not untold:
        return RIGHT if truth.expect == "built" and not row["faults"] else WARNED
    return VAGUE if row["warnings"] else SILENT


def untold_faults(row: dict[str, Any], truth: Truth | None = None) -> list[str]:
    """Return the faults of a row of which no warning speaks.

    A warning speaks of a fault where it names what is wrong (the floor of a floor, the track of sleepers) near its
    place, or a cause that can make such a fault (see `Spoiler`). One that names the trouble which the truth knows, and
    its place, speaks of the shape there.

    Args:
        row: A row with faults and warnings.
        truth: Its truth; `None` where only the row was kept: then no trouble is known.
    """
    trouble = truth is not None and bool(truth.cause) and _names_trouble(row["warnings"], truth)
    untold = []
    for fault in row["faults"]:
        place = _fault_place(fault)
        if trouble and re.search(_SHAPE, fault) and _in_trouble(place, truth):
            continue
        where = truth.trouble if math.isnan(place) and truth is not None else (place, place)
        if not any(_speaks_of(text, fault, where, row) for text in row["warnings"]):
            untold.append(fault)
    return untold


def _names_trouble(warnings: list[str] | tuple[str, ...], truth: Truth) -> bool:
    """Return whether the warnings that name the true cause also name its place."""
    told = [text for text in warnings if names_cause([text], truth)]
    return bool(told) and names_place(told, truth)


def _in_trouble(place: float, truth: Truth | None) -> bool:
    """Return whether a fault at a true station, or one without, may be of the trouble, if that has a place."""
    start, end = truth.trouble if truth is not None else (math.nan, math.nan)
    return not math.isnan(start) and (math.isnan(place) or start - _PLACE_SLACK <= place <= end + _PLACE_SLACK)


def _fault_place(fault: str) -> float:
    """Return the true station of a fault, m; NaN where it has none."""
    found = _FAULT_PLACE.search(fault)
    return float(found[1]) if found else math.nan


def _speaks_of(warning: str, fault: str, where: tuple[float, float], row: dict[str, Any]) -> bool:
    """Return whether a warning is of a fault, and of its true stations where both have a place."""
    if any(cause.named(warning) for cause in _SPOILERS):
        told = any(cause.explains(warning, fault) for cause in _SPOILERS)
    else:
        named = _GUESS.sub("", warning)  # what it looks like names floor and walls, whatever is wrong
        told = any(words.search(named) for beginning, words in _TOLD_BY if beginning.search(fault))
    if not told:
        return False
    ranges = [(float(a or c), float(b or c)) for a, b, c in _RANGE.findall(warning)]
    if math.isnan(where[0]) or not ranges:
        return True
    start, end = where[0] - _FAULT_SLACK, where[1] + _FAULT_SLACK
    # The scene counts from its own start, which may be either end; rows of before do not say which.
    ways = {False: (start - row["from"], end - row["from"]), True: (row["to"] - end, row["to"] - start)}
    spans = [ways[row["reversed"]]] if "reversed" in row else list(ways.values())
    return any(low <= b and a <= high for a, b in ranges for low, high in spans)


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
