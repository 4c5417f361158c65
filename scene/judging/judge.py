"""The built bore against all that was registered: fractions, places, unseen wall, and whether to warn or to refuse."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import tyro

from scene.bore import Bore
from scene.cleaning.sort import Removed
from scene.cloud import Cloud
from scene.errors import OUTSIDE, Code, FitError
from scene.judging.places import (
    BEHIND,
    BEYOND,
    EXPLAINED,
    INSIDE,
    Coverage,
    Place,
    Returns,
    TrackZone,
    compare_returns,
    find_places,
    find_unseen,
    measure_overruns,
    name_span,
)

_FLAG = tyro.conf.arg(prefix_name=False)
_LISTED = 10  # places and worst stations that are listed
_WINDOW = 2.0  # m of bore that one worst station stands for
_WARN_LOCAL = 0.05  # of the returns at a place's stations: a place with fewer is listed without a warning
_WARN_UNSEEN = 0.10  # of the girth


@dataclass(frozen=True)
class JudgingConfig:
    """Limits by which a built bore is judged against all returns."""

    tolerance: float = 0.10  # A return this near to the model is explained by it, m.
    warn_above: float = 0.05  # Fraction of unexplained returns between the ends above which the build warns.
    refuse_above: float = 0.35  # Fraction above which it fails; what was cut away as another bore or terrain is out.
    force: Annotated[bool, _FLAG] = False  # Build all the same where the judgement would refuse.


@dataclass(frozen=True)
class Warned:
    """One thing that a user must know."""

    code: Code  # What it is about, for programs
    text: str  # Sentence for people
    start: float | None = None  # First station, m; `None` where it concerns the whole bore
    end: float | None = None  # Last station, m
    refuses: bool = False  # True where the build fails without `--force`


@dataclass(frozen=True)
class Judgement:
    """Returns that the model explains, wall that nobody saw, and warnings for the user."""

    tolerance: float  # Distance up to which a return is explained, m
    warnings: tuple[Warned, ...]  # The gravest first
    returns: Returns | None = None  # All returns about the bore; `None` for a ring survey
    coverage: Coverage | None = None  # Unseen wall
    places: tuple[Place, ...] = ()  # Unexplained returns, the largest place first
    scattered: float = 0.0  # Fraction of the returns between the ends that are unexplained and belong to no place
    worst: tuple[tuple[float, float, float], ...] = ()  # First and last station, m, and fraction unexplained

    @property
    def fractions(self) -> dict[str, float]:
        """Fractions of the returns: `explained`, `inside` and `behind` of those between the ends, `beyond` of all."""
        kinds = {"explained": EXPLAINED, "inside": INSIDE, "behind": BEHIND, "beyond_ends": BEYOND}
        return {} if self.returns is None else {name: self.returns.fraction(kind) for name, kind in kinds.items()}

    @property
    def facts(self) -> dict[str, Any]:
        result: dict[str, Any] = {"warnings": [_entry(warning) for warning in self.warnings]}
        if self.returns is None or self.coverage is None:
            return result
        return {
            **result, "tolerance": self.tolerance, "returns": float(self.returns.weight.sum()),
            "share": {**self.fractions, "scattered": self.scattered}, "wall_seen": self.coverage.fraction,
            "unseen": [vars(patch) for patch in self.coverage.patches[:_LISTED]],
            "places": [vars(place) for place in self.places[:_LISTED]],
            "worst_stations": [{"start": a, "end": b, "unexplained": fraction} for a, b, fraction in self.worst],
        }  # fmt: skip

    def summary(self) -> str:
        """Return the fractions in one line for people."""
        if self.returns is None:
            return "judged: a ring survey holds no returns to judge by"
        part = self.fractions
        text = (
            f"judged: {part['explained']:.1%} of {self.returns.weight.sum():,.0f} returns within "
            f"{100 * self.tolerance:.0f} cm of the model, {part['inside']:.1%} inside, {part['behind']:.1%} behind "
            f"the wall, {part['beyond_ends']:.1%} beyond the ends"
        )
        return f"{text}; worst {name_span(*self.worst[0][:2])} ({self.worst[0][2]:.0%})" if self.worst else text


def _entry(warning: Warned) -> dict[str, Any]:
    place = {} if warning.start is None else {"start": warning.start, "end": warning.end}
    return {"code": warning.code, "text": warning.text, **place}


def judge_bore(
    bore: Bore,
    everything: Cloud,
    config: JudgingConfig,
    track: TrackZone | None = None,
    cause: np.ndarray | None = None,
    removed: tuple[Removed, ...] = (),
) -> Judgement:
    """Judges a bore against every return of the registered cloud before cleaning, `everything`, in the bore's frame.

    `cause` holds the `Cause` of each of its points, `(n,)`, `None` where nothing was cut; `track` is the space of the
    track, `None` where none was laid.
    """
    returns = compare_returns(bore, everything, config.tolerance, track)
    coverage = find_unseen(bore, returns)
    places, strays = find_places(bore, returns)
    inside = float(returns.weight[returns.in_span].sum())
    worst = _worst_windows(bore, returns)
    warnings = [
        *_warn_of_fraction(returns, cause, places, worst, config),
        *(Warned(Code.CUT, part.warning, part.start, part.end) for part in removed if part.warning),
        *_warn_of_ends(bore, returns),
        *_warn_of_unseen(coverage),
        *_warn_of_places(places, config.tolerance),
    ]
    scattered = float(returns.weight[strays].sum()) / max(inside, 1e-9)
    return Judgement(config.tolerance, tuple(warnings), returns, coverage, places, scattered, worst)


def _warn_of_fraction(
    returns: Returns,
    cause: np.ndarray | None,
    places: tuple[Place, ...],
    worst: tuple[tuple[float, float, float], ...],
    config: JudgingConfig,
) -> list[Warned]:
    counted = returns.in_span
    if cause is not None:
        counted = counted & ~np.isin(cause, OUTSIDE)
    total = float(returns.weight[counted].sum())
    inside, behind = (
        float(returns.weight[counted & (returns.kind == kind)].sum()) / max(total, 1e-9) for kind in (INSIDE, BEHIND)
    )
    result = []
    if inside + behind > config.warn_above:
        where = f", most {name_span(*worst[0][:2])}" if worst else ""
        result.append(Warned(
            Code.UNEXPLAINED,
            f"{inside + behind:.0%} of the returns lie further than {100 * config.tolerance:.0f} cm from the tunnel "
            f"that was built ({inside:.0%} inside it, {behind:.0%} behind its wall){where}",
            refuses=inside + behind > config.refuse_above,
        ))  # fmt: skip
    return result


_WARN_BEYOND = 0.25  # of all returns
_CUT_SHORT = 2.0  # m of lining beyond an end that are worth a word


def _warn_of_ends(bore: Bore, returns: Returns) -> list[Warned]:
    result = []
    if returns.fraction(BEYOND) > _WARN_BEYOND:
        result.append(Warned(
            Code.BEYOND,
            f"{returns.fraction(BEYOND):.0%} of all returns lie beyond the ends of what was built, at 0 and "
            f"{bore.length:.0f} m: terrain, a hall, or a stretch of tunnel behind a gap, which is a cloud of its own",
        ))  # fmt: skip
    for beyond, where, station in zip(measure_overruns(bore, returns), ("before", "beyond"), (0.0, bore.length),
                                      strict=True):  # fmt: skip
        if beyond >= _CUT_SHORT:
            result.append(Warned(
                Code.CUT_SHORT,
                f"the lining goes on for at least {beyond:.0f} m {where} station {station:.0f} m, which were not "
                "built: is it seen from too far away there, or hidden?",
                station, station,
            ))  # fmt: skip
    return result


def _warn_of_unseen(coverage: Coverage) -> list[Warned]:
    return [
        Warned(
            Code.UNSEEN,
            f"{name_span(patch.start, patch.end)} hardly a return lies {_on(patch.sides)} "
            f"({patch.fraction:.0%} of the girth, {patch.area:.0f} m²): the wall there is a guess",
            patch.start, patch.end,
        )
        for patch in coverage.patches[:_LISTED] if patch.fraction > _WARN_UNSEEN
    ]  # fmt: skip


def _on(sides: str) -> str:
    return sides if sides == "all around" else f"on the {sides}"


def _warn_of_places(places: tuple[Place, ...], tolerance: float) -> list[Warned]:
    return [
        Warned(
            Code.PLACE,
            f"{name_span(place.start, place.end)}, {place.sides}: {place.fraction:.0%} of the returns there are not "
            f"the wall that was built, up to {place.furthest:.1f} m {'behind' if place.behind else 'inside'} it, "
            f"{place.low:.1f} to {place.high:.1f} m above the floor",
            place.start, place.end,
        )
        for place in places[:_LISTED] if place.fraction > _WARN_LOCAL and place.furthest > tolerance
    ]  # fmt: skip


def _worst_windows(bore: Bore, returns: Returns) -> tuple[tuple[float, float, float], ...]:
    """Windows with the largest fraction of unexplained returns, which do not touch."""
    count = max(int(bore.length / _WINDOW), 1)
    edges = np.linspace(0.0, bore.length, count + 1)
    total, wrong = (
        np.histogram(returns.station[rows], edges, weights=returns.weight[rows])[0]
        for rows in (returns.in_span, (returns.kind == INSIDE) | (returns.kind == BEHIND))
    )
    fraction = wrong / np.maximum(total, 1e-9)
    result: list[int] = []
    for k in np.argsort(-fraction, kind="stable"):
        if fraction[k] <= 0.0 or len(result) == _LISTED:
            break
        if all(abs(int(k) - other) > 1 for other in result):
            result.append(int(k))
    return tuple((float(edges[k]), float(edges[k + 1]), float(fraction[k])) for k in result)


def require_trust(judgement: Judgement, force: bool) -> None:
    """Raises `FitError` where a warning refuses the bore and `force` is not set.

    A clock that is off is named first, else poses that blur the walls: what is wrong with the bore follows from them.
    """
    grave = [warning for warning in judgement.warnings if warning.refuses]
    if grave and not force:
        causes = [one for code in (Code.CLOCK, Code.POSES) for one in judgement.warnings if one.code == code]
        cause = "".join(f"{one.text}; so " for one in causes[:1])
        raise FitError(f"{cause}{grave[0].text}; --force builds it all the same", grave[0].code)
