"""Smallest faults noticed: at each of many places sizes are halved in on, and a detection curve is fitted to them."""

from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from scipy.optimize import minimize
from scipy.special import ndtr
from scipy.stats import beta, norm

from benchmarks.fidelity.case import Case, case_hash, release_memory
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.faults.kinds import KINDS, local_site
from benchmarks.fidelity.faults.rows import asked_faults
from benchmarks.fidelity.files import FidelityError, read_kept, write_csv, write_json
from benchmarks.fidelity.windows.judge import Worst, noticed_by, worst_windows
from scene.progress import Stages

matplotlib.use("Agg")

SCHEMA = "subterra.fidelity-ladder/1"
SHARE = 0.95
CONFIDENCE = 0.95
_RUNG = 2.0 ** (1.0 / 3.0)  # of a size over the next smaller one
_BELOW, _ABOVE = 12, 3  # rungs below and above the size asked for
_EDGE = 4.0  # m that a fault keeps from the mouths: what is squeezed before it lies inside
_LEAST_SPREAD = np.log(_RUNG) / 4.0  # of the logarithms of sizes: finer than a rung nothing is known
_DRAWS = 400  # of places, for the interval
_COLUMNS = ("kind", "words", "unit", "length", "places", "asked", "noticed_at_asked", "size_50", "size_95", "low",
            "high")  # fmt: skip


def check_ladder(kinds: tuple[str, ...], places: int, draw: int = 0) -> None:
    """Refuses a ladder that cannot be climbed anywhere."""
    if places < 1:
        raise FidelityError(f"places must be at least 1, got {places}")
    if draw < 0:
        raise FidelityError(f"draw must not be negative, got {draw}")
    if unknown := [name for name in kinds if name not in asked_faults()]:
        raise FidelityError(f"no size of {unknown[0]!r} is asked for; a ladder has {', '.join(asked_faults())}")


def rungs(kind: str) -> Float[np.ndarray, " r"]:
    """Return the sizes of a kind's ladder, the smallest first."""
    return asked_faults()[kind].size * _RUNG ** np.arange(-_BELOW, _ABOVE + 1)


def draw_place(kind: str, draw: int, number: int, length: float) -> Fault:
    """Draws place, direction and side of a fault of the size asked for, in a tunnel of `length` m."""
    asked, one = asked_faults()[kind], KINDS[kind]
    rng = np.random.default_rng(np.random.SeedSequence(draw, spawn_key=(list(asked_faults()).index(kind), number)))
    start = float(rng.uniform(_EDGE, length - _EDGE - asked.length))
    sign = float(rng.choice([-1.0, 1.0])) if one.signed else 1.0
    return replace(asked, start=start, size=asked.size * sign, side=float(rng.choice(one.sides)))


def climb_ladders(case: Case, kinds: tuple[str, ...], places: int, draw: int, folder: Path) -> list[dict[str, Any]]:
    """Finds the smallest noticed size at each place; places kept from an earlier run are not done again.

    Args:
        case: Case of the good candidate.
        kinds: Kinds of fault; all that a size is asked of where empty.
        places: Number of places of each kind.
        draw: Seed that draws them.
        folder: Folder that keeps `ladder.json`.
    """
    kinds, length = kinds or tuple(asked_faults()), case.candidate.length
    least = max(asked_faults()[name].length for name in kinds) + 2.0 * _EDGE + 1.0
    if length < least:
        raise FidelityError(f"a ladder of these faults needs {least:g} m of tunnel, this one has {length:.1f} m")
    key = sha256(f"{case_hash(case)} {draw}".encode()).hexdigest()
    path = folder / "ladder.json"
    done = {(row["kind"], row["number"]): row for row in read_kept(path, SCHEMA, key).get("rows", [])}
    wanted = [(kind, number) for number in range(places) for kind in kinds]
    site = local_site(case)
    before = worst_windows(case)
    with Stages() as progress:
        stage = progress.start("places", len(wanted))
        if known := sum(one in done for one in wanted):
            stage.resume(known)
        for kind, number in wanted:
            if (kind, number) in done:
                continue
            known_rungs = [row["rung"] for row in done.values() if row["kind"] == kind]
            guess = int(np.median(known_rungs)) if known_rungs else -1
            fault = draw_place(kind, draw, number, length)
            done[kind, number] = _climb(site, before, fault, guess) | {"number": number}
            write_json(path, {"schema": SCHEMA, "key": key, "rows": list(done.values())})
            release_memory()
            stage.advance()
    return [done[one] for one in wanted]


def _climb(site: Site, before: list[Worst], fault: Fault, guess: int = -1) -> dict[str, Any]:
    """Return a row of one place: the sizes tried and the window that noticed each, and the smallest rung noticed.

    The size asked for is tried first, then the rungs above or below it, as if whatever is noticed were noticed at every
    larger size too.
    """
    sizes, tried = rungs(fault.kind), dict[int, tuple[str, ...]]()
    low, high, rung = -1, len(sizes), _BELOW  # the smallest noticed rung lies above `low`, and is `high` or below
    while high - low > 1:
        one = replace(fault, size=float(np.sign(fault.size) * sizes[rung]))
        by = tried[rung] = noticed_by(put_in(site, one), before)
        low, high = (low, rung) if by else (rung, high)
        rung = next_rung(low, high, guess)
    return {**asdict(fault), "scene": site.candidate.name, "rung": high,
            "tried": [{"size": float(sizes[k]), "by": list(by)} for k, by in tried.items()]}  # fmt: skip


def next_rung(low: int, high: int, guess: int = -1) -> int:
    """Return the rung to try between a missed and a noticed one: the guess, its neighbour, or the middle."""
    if low < guess < high:
        return guess
    if guess == high:
        return high - 1
    return low + 1 if guess == low and low >= 0 else (low + high) // 2


def fit_curve(rung: np.ndarray, count: int) -> tuple[float, float]:
    """Fits a normal curve over the logarithm of the size to the smallest noticed rungs of places.

    Args:
        rung: Smallest noticed rung of each place; `count` where none was.
        count: Number of rungs.

    Returns:
        Middle and spread, in natural logarithms over the lowest rung.
    """
    step = np.log(_RUNG)
    low = np.where(rung > 0, (rung - 1) * step, -np.inf)
    high = np.where(rung < count, rung * step, np.inf)

    def misfit(at: np.ndarray) -> float:
        spread = max(float(np.exp(at[1])), _LEAST_SPREAD)
        inside = ndtr((high - at[0]) / spread) - ndtr((low - at[0]) / spread)
        return float(-np.log(np.maximum(inside, 1e-12)).sum())

    middle = float(np.mean(np.clip((rung - 0.5) * step, 0.0, count * step)))
    start = np.array([middle, np.log(max(float(np.std(rung * step)), 2.0 * _LEAST_SPREAD))])
    best = minimize(misfit, start, method="Nelder-Mead").x
    return float(best[0]), max(float(np.exp(best[1])), _LEAST_SPREAD)


def sum_up(rows: list[dict[str, Any]], draw: int = 0) -> list[dict[str, Any]]:
    """Return a row per kind: sizes noticed at half and at 95 % of places, with the interval of the latter."""
    table = []
    for kind, asked in asked_faults().items():
        rung = np.array([row["rung"] for row in rows if row["kind"] == kind])
        if not len(rung):
            continue
        sizes, rng = rungs(kind), np.random.default_rng(draw)
        half, most = _shares(rung, sizes)
        again = [_shares(rng.choice(rung, len(rung)), sizes)[1] for _ in range(_DRAWS)]
        low, high = np.percentile(again, [50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)])
        table.append({
            "kind": kind, "words": KINDS[kind].words, "unit": KINDS[kind].unit, "length": asked.length,
            "places": len(rung), "asked": asked.size, "noticed_at_asked": int((rung <= _BELOW).sum()),
            "size_50": half, "size_95": most, "low": float(low), "high": float(high),
        })  # fmt: skip
    return table


def _shares(rung: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """Return the sizes that half and 95 % of places notice, by the fitted curve."""
    middle, spread = fit_curve(rung, len(sizes))
    return float(sizes[0] * np.exp(middle)), float(sizes[0] * np.exp(middle + norm.ppf(SHARE) * spread))


def share_noticed(rung: np.ndarray, count: int) -> Float[np.ndarray, "3 r"]:
    """Return the share of places that notice each rung, and the bounds of its exact interval."""
    n = len(rung)
    noticed = np.array([(rung <= k).sum() for k in range(count)])
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = np.where(noticed > 0, beta.ppf(tail, noticed, n - noticed + 1), 0.0)
    high = np.where(noticed < n, beta.ppf(1.0 - tail, noticed + 1, n - noticed), 1.0)
    return np.stack([noticed / n, low, high])


def write_ladder(folder: Path, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Writes `ladder.csv` and `ladder.png`, and returns the table."""
    table = sum_up(rows)
    write_csv(folder / "ladder.csv", _COLUMNS, table)
    _draw(folder / "ladder.png", rows, table)
    return table


def _draw(path: Path, rows: list[dict[str, Any]], table: list[dict[str, Any]]) -> None:
    columns = min(len(table), 3)
    lines = -(-len(table) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.4 * columns, 2.3 * lines), layout="constrained", squeeze=False
    )
    for panel in axes.ravel()[len(table) :]:
        panel.set_visible(False)
    for panel, one in zip(axes.ravel(), table, strict=False):
        factor, unit = (1000.0, "mm") if one["kind"] == "gauge" else (100.0, "cm")
        rung, sizes = np.array([row["rung"] for row in rows if row["kind"] == one["kind"]]), rungs(one["kind"])
        share, low, high = share_noticed(rung, len(sizes))
        middle, spread = fit_curve(rung, len(sizes))
        fine = np.geomspace(sizes[0], sizes[-1], 200)
        panel.fill_between(factor * sizes, low, high, color="#0072b2", alpha=0.15, lw=0)
        panel.plot(factor * sizes, share, "o", ms=4, color="#0072b2")
        panel.plot(factor * fine, norm.cdf((np.log(fine / sizes[0]) - middle) / spread), color="#0072b2", lw=1.2)
        panel.axvspan(factor * one["low"], factor * one["high"], color="#d55e00", alpha=0.2, lw=0)
        panel.axvline(factor * one["size_95"], color="#d55e00", lw=1.5)
        panel.axvline(factor * one["asked"], color="black", lw=1.0, ls=":")
        panel.set(xscale="log", ylim=(-0.05, 1.05), yticks=(0.0, 0.5, 0.95), yticklabels=("0", "50 %", "95 %"))
        panel.set_title(f"{one['words']}, over {one['length']:g} m; {one['places']} places", fontsize=8)
        panel.set_xlabel(unit, fontsize=8)
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.spines[["top", "right"]].set_visible(False)
    figure.suptitle("share of the places that notice a size (band: 95 % interval); orange: noticed at 95 % of places, "
                    "with its interval; dotted: asked for", fontsize=8)  # fmt: skip
    figure.savefig(path, dpi=130)
    plt.close(figure)
