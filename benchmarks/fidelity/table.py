"""The table of the 199 metrics of the suite: `metrics.csv` with the thresholds that calibration has set."""

import csv
import json
import math
import re
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
METRICS = HERE / "metrics.csv"
THRESHOLDS = HERE / "thresholds.json"
CATEGORIES = 18
COUNT = 199
_MAP = re.compile(
    r"^(?:(?P<kind>[DU])\((?P<a>[\d.]+),(?P<b>[\d.]+)\)|B\((?P<t>[\d.]+);(?P<ba>[\d.]+),(?P<bb>[\d.]+)\)|(?P<p>P)|-)$"
)


@dataclass(frozen=True)
class Map:
    """Map from a raw value to a score of 0 to 100.

    Attributes:
        kind: `D` less is better, `U` more is better, `B` near `target` is better, `P` pass or fail, `-` not scored.
        good: Value from which on the score is 100: the noise floor where the metric has a reference; for `B` a distance
            from the target.
        bad: Value from which on the score is 0.
        target: Best value of a `B` map.
    """

    kind: str
    good: float = 0.0
    bad: float = 0.0
    target: float = 0.0

    def score(self, value: float) -> float:
        """Return the score; a value that is not a number scores 0."""
        if math.isnan(value):
            return 0.0
        if self.kind == "P":
            return 100.0 if value >= 0.5 else 0.0
        distance = abs(value - self.target) if self.kind == "B" else value
        if self.good == self.bad:
            return 100.0 if distance <= self.good else 0.0
        return 100.0 * min(max((self.bad - distance) / (self.bad - self.good), 0.0), 1.0)

    def scaled(self, factor: float) -> "Map":
        """Return the map with both thresholds times a factor.

        A share moves by its shortfall from 1; pass or fail does not move.
        """
        if self.kind == "U" and max(self.good, self.bad) <= 1.0:
            return replace(self, good=1.0 - factor * (1.0 - self.good), bad=1.0 - factor * (1.0 - self.bad))
        if self.kind in "DUB":
            return replace(self, good=factor * self.good, bad=factor * self.bad)
        return self


@dataclass(frozen=True)
class Metric:
    """A row of the table.

    Attributes:
        number: Row, 1 to 199 in the suite.
        category: Three letters.
        category_name: Name in words.
        id: Unique name.
        definition: Definition in a sentence.
        unit: Unit of value and thresholds. SI: `m`, `1/m`, `1/s`, `1` (a share, ratio or correlation), `bool`, `count`.
            Not SI, as surveyors write them: `%`, `deg`, `mm`, `mm/m`, `m/100 m`, `1/100 scans`, `nat`.
        direction: `down`, `up`, `band` or `info`.
        role: `S` scored, `G` scored and a gate, `L` logged.
        map: Map to a score.
        evidence: Letters of H held-out, T truth, K standard, S self-consistency, C true by construction.
        library: Libraries that its code calls on the way to the value; `numpy` only where there is no other.
    """

    number: int
    category: str
    category_name: str
    id: str
    definition: str
    unit: str
    direction: str
    role: str
    map: Map
    evidence: str
    library: str

    @property
    def scored(self) -> bool:
        """True where the metric counts in its category."""
        return self.role in "SG"


def parse_map(text: str) -> Map:
    """Reads `D(a,b)`, `U(a,b)`, `B(t;a,b)`, `P` or `-`.

    Raises:
        ValueError: Any other text.
    """
    match = _MAP.match(text.strip())
    if match is None:
        raise ValueError(f"{text!r} is no score map")
    if match["kind"] == "D":
        return Map("D", float(match["a"]), float(match["b"]))
    if match["kind"] == "U":
        return Map("U", float(match["b"]), float(match["a"]))
    if match["t"]:
        return Map("B", float(match["ba"]), float(match["bb"]), float(match["t"]))
    return Map("P" if match["p"] else "-")


def map_text(map: Map) -> str:
    """Return the map as the table writes it."""
    good, bad, target = (np.format_float_positional(v, trim="-") for v in (map.good, map.bad, map.target))
    texts = {"D": f"D({good},{bad})", "U": f"U({bad},{good})", "B": f"B({target};{good},{bad})"}
    return texts.get(map.kind, map.kind)


def load(frozen: dict[str, Any] | None = None) -> dict[str, Metric]:
    """Return the table by id, in its order, with calibrated thresholds, roles and noise floors.

    Args:
        frozen: Content of a calibration; that of the suite where not given.
    """
    return _load() if frozen is None else _with_thresholds(frozen)


@cache
def _load() -> dict[str, Metric]:
    return _with_thresholds(json.loads(THRESHOLDS.read_text()) if THRESHOLDS.exists() else {})


def _with_thresholds(frozen: dict[str, Any]) -> dict[str, Metric]:
    calibrated, floors = frozen.get("maps", {}), frozen.get("floors", {})
    table: dict[str, Metric] = {}
    with METRICS.open(newline="") as file:
        for row in csv.DictReader(file):
            moved = calibrated.get(row["id"], {})
            text, role = moved.get("map", row["map"]), moved.get("role", row["role"])
            map = parse_map(text)
            table[row["id"]] = Metric(
                int(row["n"]), row["cat"], row["cat_name"], row["id"], row["definition"], row["unit"],
                row["direction"], role, replace(map, good=floors.get(row["id"], map.good)), row["evidence"], row["lib"],
            )  # fmt: skip
    return table


def categories() -> dict[str, str]:
    """Return the names of the categories by their three letters, in the order of the table."""
    return {metric.category: metric.category_name for metric in load().values()}


def thresholds_hash() -> str:
    """Return the SHA-256 of table and calibrated thresholds as files."""
    frozen = THRESHOLDS.read_bytes() if THRESHOLDS.exists() else b""
    return sha256(METRICS.read_bytes() + frozen).hexdigest()
