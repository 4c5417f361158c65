"""Smallest faults noticed: sizes are halved in on at each of many places."""

from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case, case_hash, release_memory
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.faults.kinds import KINDS, asked_faults, local_site
from benchmarks.fidelity.files import FidelityError, read_kept, write_csv, write_json
from benchmarks.fidelity.windows.judge import Worst, noticed_by, worst_windows
from scene.progress import Stages

SCHEMA = "subterra.fidelity-ladder/1"
SHARE = 0.95
_RUNG = 2.0 ** (1.0 / 3.0)  # of a size over the next smaller one
_BELOW, _ABOVE = 12, 3  # rungs below and above the size asked for
_EDGE = 4.0  # m that a fault keeps from the mouths: what is squeezed before it lies inside
_COLUMNS = ("kind", "words", "unit", "length", "places", "asked", "noticed_at_asked", "size_50", "size_95")


def check_ladder(kinds: tuple[str, ...], places: int, draw: int = 0) -> None:
    if places < 1:
        raise FidelityError(f"places must be at least 1, got {places}")
    if draw < 0:
        raise FidelityError(f"draw must not be negative, got {draw}")
    if unknown := [name for name in kinds if name not in asked_faults()]:
        raise FidelityError(f"no size of {unknown[0]!r} is asked for; a ladder has {', '.join(asked_faults())}")


def rungs(kind: str) -> Float[np.ndarray, " r"]:
    return asked_faults()[kind].size * _RUNG ** np.arange(-_BELOW, _ABOVE + 1)


def draw_place(kind: str, draw: int, number: int, length: float) -> Fault:
    """Draws place, direction and side of a fault of the size asked for, in a tunnel of `length` m."""
    asked, one = asked_faults()[kind], KINDS[kind]
    rng = np.random.default_rng(np.random.SeedSequence(draw, spawn_key=(list(asked_faults()).index(kind), number)))
    start = float(rng.uniform(_EDGE, length - _EDGE - asked.length))
    sign = float(rng.choice([-1.0, 1.0])) if one.signed else 1.0
    return replace(asked, start=start, size=asked.size * sign, side=float(rng.choice(one.sides)))


def climb_ladders(case: Case, kinds: tuple[str, ...], places: int, draw: int, folder: Path) -> list[dict[str, Any]]:
    """Finds the smallest noticed size at each place; places kept from an earlier run are not done again."""
    kinds, length = kinds or tuple(asked_faults()), case.candidate.length
    least = max(asked_faults()[name].length for name in kinds) + 2.0 * _EDGE + 1.0
    if length < least:
        raise FidelityError(f"a ladder of these faults needs {least:g} m of tunnel, this one has {length:.1f} m")
    key = sha256(f"{case_hash(case)} {draw}".encode()).hexdigest()
    path = folder / "ladder.json"
    done = {(row["kind"], row["number"]): row for row in read_kept(path, SCHEMA, key).get("rows", [])}
    needed = [(kind, number) for number in range(places) for kind in kinds]
    site = local_site(case)
    before = worst_windows(case)
    with Stages() as progress:
        stage = progress.start("places", len(needed))
        if known := sum(one in done for one in needed):
            stage.resume(known)
        for kind, number in needed:
            if (kind, number) in done:
                continue
            known_rungs = [row["rung"] for row in done.values() if row["kind"] == kind]
            guess = int(np.median(known_rungs)) if known_rungs else -1
            fault = draw_place(kind, draw, number, length)
            done[kind, number] = _climb(site, before, fault, guess) | {"number": number}
            write_json(path, {"schema": SCHEMA, "key": key, "rows": list(done.values())})
            release_memory()
            stage.advance()
    return [done[one] for one in needed]


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


def sum_up(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per kind: the smallest sizes that half and 95 % of the places notice; infinite where no size is."""
    table = []
    for kind, asked in asked_faults().items():
        rung = np.array([row["rung"] for row in rows if row["kind"] == kind])
        if not len(rung):
            continue
        sizes = np.append(rungs(kind), np.inf)
        half, most = (float(sizes[np.quantile(rung, share, method="higher")]) for share in (0.5, SHARE))
        table.append({
            "kind": kind, "words": KINDS[kind].words, "unit": KINDS[kind].unit, "length": asked.length,
            "places": len(rung), "asked": asked.size, "noticed_at_asked": int((rung <= _BELOW).sum()),
            "size_50": half, "size_95": most,
        })  # fmt: skip
    return table


def write_ladder(folder: Path, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    table = sum_up(rows)
    write_csv(folder / "ladder.csv", _COLUMNS, table)
    return table
