"""Random local faults: drawn, put in one by one, kept as they are done, and summed up as detection curves."""

import csv
import io
import json
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from benchmarks.fidelity.case import Case, case_hash, release_memory
from benchmarks.fidelity.controls.local import KINDS, draw_fault, make_ground, spoil
from benchmarks.fidelity.files import FidelityError, read_json, write_json, write_text
from benchmarks.fidelity.windows.judge import noticed_by, windows_hash, worst_windows
from benchmarks.fidelity.windows.near import Nearby
from scene.progress import Stages

matplotlib.use("Agg")

SCHEMA = "subterra.fidelity-faults/1"
LONG_ENOUGH = 5.0  # m; faults shorter than a window are drawn as open circles and not counted in a smallest size
SHARE = 0.95
_AT_LEAST = 5  # faults of a size or larger that a share is told of
_REACH = 2.0  # largest over smallest size among which the share is taken
_COLUMNS = ("kind", "words", "unit", "count", "noticed", "long", "largest_missed", "size_95")


def check_draw(count: int, draw: int, kinds: tuple[str, ...]) -> None:
    """Refuses a draw that cannot be made.

    Raises:
        FidelityError: In one sentence.
    """
    if count < 1:
        raise FidelityError(f"count must be at least 1, got {count}")
    if draw < 0:
        raise FidelityError(f"draw must not be negative, got {draw}")
    known = [name for name, kind in KINDS.items() if kind.sizes]
    if unknown := [name for name in kinds if name not in known]:
        raise FidelityError(f"no kind of fault {unknown[0]!r}; there are {', '.join(known)}")


def run_faults(
    case: Case, count: int, draw: int, kinds: tuple[str, ...], folder: Path, near: bool = False
) -> list[dict[str, Any]]:
    """Draws and puts in faults; those kept from an earlier run on the same case, code and draw are not done again.

    Args:
        case: Case of the good candidate.
        count: Number of faults.
        draw: Seed that draws them.
        kinds: Kinds to draw from; all where empty.
        folder: Folder that keeps `faults.json`.
        near: Judge only the windows near each fault, and keep the first that is beyond its limit.
    """
    key = sha256(f"{case_hash(case)} {windows_hash()} {draw} {kinds} {near}".encode()).hexdigest()
    path = folder / "faults.json"
    content = json.loads(path.read_text()) if path.exists() else {}
    rows: list[dict[str, Any]] = content["rows"][:count] if content.get("key") == key else []
    ground, before = make_ground(case.candidate), worst_windows(case)
    nearby = Nearby(case, ground, before) if near else None
    with Stages() as progress:
        stage = progress.start("faults", count)
        if rows:
            stage.resume(len(rows))
        for number in range(len(rows), count):
            rng = np.random.default_rng(np.random.SeedSequence(draw, spawn_key=(number,)))
            fault = draw_fault(rng, case.candidate.length, kinds[number % len(kinds)] if kinds else None)
            spoilt = spoil(ground, fault)
            if nearby is None:
                by = noticed_by(case, spoilt, before)
            else:
                first = nearby.first_beyond(spoilt, *fault.extent())
                by = (first,) if first else ()
            rows.append({"scene": case.candidate.name, "number": number, **asdict(fault), "by": list(by)})
            write_json(path, {"schema": SCHEMA, "key": key, "rows": rows})
            release_memory()
            stage.advance()
    return rows


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Reads the faults of an earlier run.

    Raises:
        FidelityError: The folder holds none.
    """
    return list(read_json(folder / "faults.json", SCHEMA)["rows"])


def smallest_noticed(size: Float[np.ndarray, " n"], noticed: np.ndarray) -> float | None:
    """Return the smallest size from which on 95 % are noticed; `None` where too few or too small ones were drawn.

    A size counts where, of the faults from it to twice it, at least 95 % (and at least five) were noticed, and where
    that holds for every larger size that has five.
    """
    order = np.argsort(size)
    size, noticed = np.asarray(size)[order], np.asarray(noticed, bool)[order]
    best = None
    for k in range(len(size) - 1, -1, -1):
        group = noticed[(size >= size[k]) & (size <= _REACH * size[k])]
        if len(group) < _AT_LEAST:
            continue
        if group.mean() < SHARE:
            break
        best = float(size[k])
    return best


def sum_up(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per kind: how many, how many noticed, the largest missed, the smallest noticed at 95 %."""
    result = []
    for name, kind in KINDS.items():
        own = [row for row in rows if row["kind"] == name]
        if not own:
            continue
        far = [row for row in own if row["length"] >= LONG_ENOUGH]
        size = np.array([abs(row["size"]) for row in far])
        noticed = np.array([bool(row["by"]) for row in far], bool)
        missed = size[~noticed]
        result.append({
            "kind": name, "words": kind.words, "unit": kind.unit, "count": len(own),
            "noticed": sum(bool(row["by"]) for row in own), "long": len(far),
            "largest_missed": float(missed.max()) if len(missed) else None, "size_95": smallest_noticed(size, noticed),
        })  # fmt: skip
    return result


def write_curves(folder: Path, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Writes `curves.csv` and `curves.png` over faults of one or more scenes, and returns the table."""
    table = sum_up(rows)
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: "" if row[key] is None else row[key] for key in _COLUMNS} for row in table)
    write_text(folder / "curves.csv", text.getvalue())
    _draw(folder / "curves.png", rows, table)
    return table


def _draw(path: Path, rows: list[dict[str, Any]], table: list[dict[str, Any]]) -> None:
    columns = 4
    lines = -(-len(table) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(12, 2.1 * lines), layout="constrained", squeeze=False)
    scenes = len({row["scene"] for row in rows})
    for panel in axes.ravel()[len(table) :]:
        panel.set_visible(False)
    for panel, one in zip(axes.ravel(), table, strict=False):
        own = [row for row in rows if row["kind"] == one["kind"]]
        factor, unit = {"m": (100.0, "cm"), "rad": (180.0 / np.pi, "deg"), "1": (100.0, "%")}[one["unit"]]
        for long in (True, False):
            part = [row for row in own if (row["length"] >= LONG_ENOUGH) == long]
            size = [factor * abs(row["size"]) for row in part]
            place = [float(bool(row["by"])) + (0.06 if long else -0.06) for row in part]
            panel.plot(size, place, "o", ms=4, color="#0072b2", mfc="#0072b2" if long else "none", alpha=0.7)
        if one["size_95"] is not None:
            panel.axvline(factor * one["size_95"], color="#d55e00", lw=1.5)
        panel.set(xscale="log", ylim=(-0.25, 1.25), yticks=(0, 1), yticklabels=("missed", "noticed"))
        panel.set_title(one["words"], fontsize=8)
        panel.set_xlabel(unit, fontsize=8)
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.spines[["top", "right"]].set_visible(False)
    figure.suptitle(
        f"{len(rows)} random faults in {scenes} scene{'s' if scenes != 1 else ''}; filled: {LONG_ENOUGH:g} m long or "
        f"more; line: from there on at least 95 % of those drawn, and {_AT_LEAST} or more, were noticed",
        fontsize=9,
    )
    figure.savefig(path, dpi=130)
    plt.close(figure)
