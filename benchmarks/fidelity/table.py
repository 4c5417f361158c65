"""Metrics: one function with one decorator each, and the maps from their values to scores."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from typing import Any, Literal, get_args

import numpy as np

from benchmarks.fidelity.files import FidelityError

Need = Literal["hold", "truth", "reference"]
CATEGORIES = {
    "CEN": "Centreline and alignment", "SEC": "Cross-section dimensions",
    "C2M": "Surface accuracy: held-out real points to mesh", "CMP": "Completeness, Chamfer, F-score",
    "BEA": "Paired-beam agreement at held-out poses", "DIS": "Sensor distribution and map statistics",
    "MSH": "Mesh validity", "TRI": "Triangle quality and resolution", "TOP": "Topology", "F2D": "2-D free space",
    "F3D": "3-D free space", "OCC": "Voxel occupancy agreement (Fig. 3)", "NAV": "Navigability",
    "LIN": "Lining detail: pockets and ring grid", "TRK": "Track assets", "SCN": "MuJoCo scene on CPU",
    "PAR": "Backend and environment parity", "DEG": "Degeneracy and observability",
}  # fmt: skip
_EVIDENCE = {"hold": "H", "truth": "T", "reference": "HT", None: "S"}


@dataclass(frozen=True)
class Map:
    """Map from a raw value to a score of 0 to 100."""

    kind: str  # `D` less is better, `U` more is better, `B` near `target` is better, `P` pass or fail, `-` not scored
    # Value from which on the score is 100: the noise floor where the metric has a reference; for `B` a distance from
    # the target
    good: float = 0.0
    bad: float = 0.0  # Value from which on the score is 0
    target: float = 0.0  # Best value of a `B` map

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

    def __str__(self) -> str:
        """Return the map as its maker is called."""
        good, bad, target = (np.format_float_positional(v, trim="-") for v in (self.good, self.bad, self.target))
        texts = {"D": f"D({good},{bad})", "U": f"U({bad},{good})", "B": f"B({target};{good},{bad})"}
        return texts.get(self.kind, self.kind)


def D(good: float, bad: float) -> Map:
    """Return the map of a value of which less is better."""
    return Map("D", good, bad)


def U(bad: float, good: float) -> Map:
    """Return the map of a value of which more is better."""
    return Map("U", good, bad)


def B(target: float, good: float, bad: float) -> Map:
    """Return the map of a value that is best at a target; the ends are distances from it."""
    return Map("B", good, bad, target)


P = Map("P")
LOGGED, LOGGED_UP = Map("-"), Map("-", good=1.0)  # not scored; the second is better where it is larger


@dataclass(frozen=True)
class Metric:
    """A metric."""

    number: int  # Place in the order of categories and files, 1 to 199 in the suite
    category: str  # Three letters
    id: str  # Unique name
    definition: str  # Definition in a sentence: the first one of its function's docstring
    # Unit of value and thresholds. SI: `m`, `1/m`, `1/s`, `1` (fraction, ratio, correlation), `bool`, `count`. Not SI,
    # as surveyors write them: `%`, `deg`, `mm`, `mm/m`, `m/100 m`, `1/100 scans`, `nat`.
    unit: str
    role: str  # `S` scored, `G` scored and a gate, `L` logged
    map: Map  # Map to a score
    evidence: str  # Letters of H held-out, T truth, K standard, S self-consistency, C true by construction
    needs: Need | None  # Reference that it cannot do without
    compute: Callable[[Any], Any] = field(compare=False, repr=False)  # Function from a case to a value, or to samples
    of: Callable[[Any], float] | None = field(default=None, compare=False, repr=False)  # Statistic of the samples

    @property
    def scored(self) -> bool:
        return self.role in "SG"

    def as_row(self) -> dict[str, Any]:
        """Return everything that a verdict depends on, as plain data; words for people are no part of it."""
        plain = asdict(replace(self, compute=str, of=None))
        return {key: value for key, value in plain.items() if key not in ("definition", "compute", "of")}


_METRICS: dict[str, Metric] = {}
_own: set[str] = set()  # ids of the suite
_order: list[str] = []  # ids as they stand in their files: decorators of one function are applied from below


def metric(
    id: str,
    category: str,
    map: Map = LOGGED,
    unit: str = "1",
    *,
    gate: bool = False,
    needs: Need | None = None,
    evidence: str | None = None,
    of: Callable[[Any], float] | None = None,
    args: tuple[Any, ...] = (),
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Registers the function that computes a metric from a case; several on one function register as many metrics.

    Args:
        id: Unique name.
        category: Three letters of one of the 18 categories.
        map: `D(good, bad)`, `U(bad, good)`, `B(target, good, bad)` or `P`; `LOGGED` is listed and not scored.
        unit: Unit of the value.
        gate: A score below 50 caps the category.
        needs: `hold` a held-out recording; `truth` the generator's truth or unseen control; `reference` either.
        evidence: Letters as in `Metric`, where they do not follow from `needs`.
        of: Statistic of the `Samples` along the tunnel that the function returns; its interval is estimated with it.
        args: What the function is called with after the case.

    Raises:
        FidelityError: The category is unknown, the id is taken, or `needs` or `map` is none.
    """
    if category not in CATEGORIES:
        raise FidelityError(f"metric {id!r}: unknown category {category!r}; choose one of {', '.join(CATEGORIES)}")
    if id in _order:
        raise FidelityError(f"metric {id!r}: this id is taken, choose another")
    if needs not in (None, *get_args(Need)):
        raise FidelityError(f"metric {id!r}: needs must be hold, truth, reference or None, got {needs!r}")
    if not isinstance(map, Map):
        raise FidelityError(f"metric {id!r}: {map!r} is no score map, write D(good, bad), U(bad, good), "
                            "B(target, good, bad) or P")  # fmt: skip
    _order.append(id)
    role = "L" if map.kind == "-" else "G" if gate else "S"

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        if not callable(function):
            raise FidelityError(f"metric {id!r}: compute must be a function of a Case, got {type(function).__name__}")
        words = (function.__doc__ or id).strip().split("\n")[0].removesuffix(".")
        if function.__module__.startswith("benchmarks.fidelity.categories."):
            _own.add(id)
        letters = _EVIDENCE[needs] if evidence is None else evidence
        compute = lambda case: function(case, *args)  # noqa: E731
        _METRICS[id] = Metric(0, category, id, words, unit, role, map, letters, needs, compute, of)
        return function

    return register


@cache
def _suite() -> dict[str, Metric]:
    import benchmarks.fidelity.categories  # noqa: F401  (registers them)

    return _numbered({id: row for id, row in _METRICS.items() if id in _own})


def load() -> dict[str, Metric]:
    """Return the metrics of the suite by id, by category and then as they stand in their files."""
    return dict(_suite())


def load_all() -> dict[str, Metric]:
    suite = load()
    return suite | _numbered({id: row for id, row in _METRICS.items() if id not in suite}, len(suite))


def forget(ids: set[str]) -> None:
    for id in ids - set(_suite()):
        _METRICS.pop(id, None)
    _order[:] = [id for id in _order if id in _METRICS]


def _numbered(rows: dict[str, Metric], before: int = 0) -> dict[str, Metric]:
    place = {id: number for number, id in enumerate(_order)}
    names = list(CATEGORIES)
    ids = sorted(rows, key=lambda id: (names.index(rows[id].category) if not before else 0, place[id]))
    return {id: replace(rows[id], number=before + number + 1) for number, id in enumerate(ids)}
