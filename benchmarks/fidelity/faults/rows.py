"""The rows of faults: controls and invariances by dose, the faults that windows must notice, those of the ladder."""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.fidelity.faults import Fault, outside_kinds

TABLE = Path(__file__).with_name("controls.csv")
OUT_OF_SCENE = "all but SCN PAR"
QUIET_LIMIT = 2.0  # points that a category named as quiet may move
MONOTONE = -0.9
UNORDERED = ("N20", "N26", "N32", "N34", "N35")  # their doses are kinds, not amounts
GLOBAL_LIMIT = 0.3  # points that an invariance may move the global figure
THINNED_LIMIT = 2.0  # the same of one that leaves out beams
_UNITS: dict[str, Callable[[float], float]] = {"": float, "%": lambda dose: dose / 100.0, "deg": np.radians}


@dataclass(frozen=True)
class Control:
    """Row of the table of controls."""

    id: str  # N01 to N36, which must be noticed, I1 to I7, which must not, or the name of a kind from outside
    corruption: str  # Corruption in words
    faults: dict[float, Fault]  # Faults by dose, in growing severity
    bold: tuple[float, ...]  # Doses that must FAIL
    falls: dict[str, float]  # Points that a category must lose at least at the bold dose
    quiet: tuple[str, ...] = ()  # Categories that may move by at most 2 points
    # Categories to compute; the others keep the base's values, since nothing they read has changed
    evaluated: str = "all"
    limit: float | None = None  # Points that an invariance may move a category; `None` for a fault that must be noticed
    exempt: tuple[str, ...] = ()  # Categories that an invariance may move
    reason: str = ""  # Reason for a difference from the specification; empty where there is none
    kind: str = "negative"  # `negative`, `invariance`, or `outside` for one of a user's own, which decides no verdict


def load_controls() -> dict[str, Control]:
    """Return the controls by id, in order: those of the suite, then those from outside."""
    more = {
        name: Control(name, kind.words, {d: Fault(name, d) for d in kind.doses}, kind.doses[-1:], kind.falls,
                      kind="outside")
        for name, kind in outside_kinds().items() if kind.doses
    }  # fmt: skip
    return suite_controls() | more


@cache
def suite_controls() -> dict[str, Control]:
    with TABLE.open(newline="") as file:
        return {row["id"]: _read_control(row) for row in csv.DictReader(file)}


def _read_control(row: dict[str, str]) -> Control:
    doses, kinds, unit = _numbers(row["doses"]), row["kind"].split(), _UNITS[row["unit"]]
    sizes, kinds = _numbers(row["sizes"]) or doses, kinds if len(kinds) == len(doses) else kinds * len(doses)
    faults = {d: Fault(kind, float(unit(s))) for d, kind, s in zip(doses, kinds, sizes, strict=True)}
    falls = {pair.split()[0]: float(pair.split()[1]) for pair in row["falls"].split(";") if pair.strip()}
    limit = float(row["limit"]) if row["limit"] else None
    return Control(
        row["id"], row["corruption"], faults, _numbers(row["bold"]), falls, tuple(row["quiet"].split()),
        row["evaluated"], limit, tuple(row["exempt"].split()), row["reason"],
        "negative" if limit is None else "invariance",
    )  # fmt: skip


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def stated_faults(length: float) -> dict[str, Fault]:
    """Return the nine faults that an earlier verdict let pass or must notice, placed in a tunnel of `length` m."""
    middle = 0.5 * length
    return {
        "mirrored left to right": Fault("mirror"),
        "roof 8 cm too low over the last 12 m": Fault("roof", -0.08, length - 12.0, 12.0, np.pi / 2),
        "one wall 10 cm out over 4.5 m": Fault("wall", 0.10, middle - 2.2, 4.5),
        "one wall 15 cm out over 3.5 m": Fault("wall", 0.15, middle - 1.7, 3.5, np.pi),
        "everything 10 cm aside over 3.5 m": Fault("aside", 0.10, middle - 1.7, 3.5),
        "rails floating 3 cm": Fault("rails", 0.03),
        "rails floating 3 cm over 8 m": Fault("rails", 0.03, middle - 4.0, 8.0),
        "everything 15 cm along over 10 m": Fault("along", 0.15, middle - 5.0, 10.0),
        "gauge 6 mm too wide over 10 m": Fault("gauge", 0.006, middle - 5.0, 10.0),
    }


_OUTSIDE_LENGTH = 5.0  # m of a user's own fault on the ladder


def asked_faults() -> dict[str, Fault]:
    """Return the faults of which a size must be noticed, by kind, without a place; then those of users' files."""
    rows = (("wall", 0.05, 5.0), ("roof", 0.05, 5.0), ("aside", 0.05, 5.0), ("gauge", 0.005, 10.0),
            ("along", 0.15, 10.0), ("rails", 0.02, 5.0))  # fmt: skip
    more = ((name, kind.doses[-1], _OUTSIDE_LENGTH) for name, kind in outside_kinds().items() if kind.doses)
    return {kind: Fault(kind, size, None, length) for kind, size, length in (*rows, *more)}
