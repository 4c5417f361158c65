"""Scores: categories beside the null tube, controls against categories, sweep and seeds."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import BLUE, GREEN, GREY, INK, RED
from benchmarks.fidelity.scoring import PASS_CATEGORY

_KINDS = ("common", "category", "independent", "tolerance", "seed")


def categories(sheet: Sheet) -> Drawn:
    """F13: bars of the categories, sorted, with the null tube and the truth as candidate."""
    entries = sheet.report["categories"]
    order = sorted(entries, key=lambda c: -1.0 if entries[c]["score"] is None else entries[c]["score"])
    failed = {m["category"] for m in sheet.report["metrics"] if m["status"] == "gate failed"}
    figure, axes = plt.subplots(figsize=(9, 5.6), layout="constrained")
    for row, name in enumerate(order):
        score, null, ceiling = (entries[name][key] for key in ("score", "null", "ceiling"))
        if score is None:
            axes.text(1, row, "no reference", va="center", color=GREY)
        else:
            axes.barh(row, score, height=0.62, color=RED if name in failed else BLUE)
        if null is not None:
            axes.plot(null, row, "D", color=GREY, markeredgecolor=INK, ms=6)
        if ceiling is not None:
            axes.plot(ceiling, row, "|", color=GREEN, ms=13, mew=2.5)
    axes.axvline(PASS_CATEGORY, color=INK, lw=0.8, ls=":")
    axes.set(
        yticks=range(len(order)),
        yticklabels=[f"{c}  {entries[c]['name']}" for c in order],
        xlim=(0, 103),
        ylim=(-0.7, len(order) - 0.3),
        xlabel="score",
    )
    line = plt.Line2D
    marks = [
        line([], [], color=BLUE, lw=7, label="reconstruction"),
        line([], [], color=RED, lw=7, label="with a failed gate"),
        line([], [], marker="D", ls="", color=GREY, markeredgecolor=INK, label="null tube"),
        line([], [], marker="|", ls="", ms=13, mew=2.5, color=GREEN, label="truth as candidate"),
    ]
    axes.legend(handles=marks, loc="upper center", bbox_to_anchor=(0.4, -0.09), ncol=4, frameon=False)
    scored = sum(m["score"] is not None for m in sheet.report["metrics"])
    return figure, "Categories, sorted; dotted: least score for PASS." + sheet.note(scored).replace(
        "n =", "Scored metrics n ="
    )


def heat_map(sheet: Sheet) -> Drawn | None:
    """F14: points lost by each category under each control at its bold dose."""
    rows = [row for row in sheet.controls if row["bold"]]
    if not rows:
        return None
    names = list(sheet.report["categories"])
    drop = np.array([[np.nan if row["falls"][c] is None else row["falls"][c] for c in names] for row in rows], float)
    figure, axes = plt.subplots(figsize=(9.5, 1.4 + 0.24 * len(rows)), layout="constrained")
    picture = axes.imshow(drop, cmap="Blues", vmin=0, vmax=100, aspect="auto")
    for y, row in enumerate(rows):
        for x, name in enumerate(names):
            if name in row.get("short", {}):
                axes.text(x, y, "x", ha="center", va="center", color=RED, fontsize=12, fontweight="bold")
            elif np.isfinite(drop[y, x]) and abs(drop[y, x]) >= 0.5:
                axes.text(
                    x,
                    y,
                    f"{drop[y, x]:.0f}",
                    ha="center",
                    va="center",
                    fontsize=7,
                    color="white" if drop[y, x] > 45 else INK,
                )
    axes.set(xticks=range(len(names)), xticklabels=names, yticks=range(len(rows)))
    axes.set_yticklabels([f"{row['id']} {row['corruption'][:44]} · {row['dose']:g}" for row in rows], fontsize=7)
    axes.xaxis.tick_top()
    figure.colorbar(picture, label="points lost", shrink=0.5)
    return (
        figure,
        "Points that each category loses under each control; x marks a fall that is short of what is asked."
        + sheet.note(len(rows)),
    )


def strips(sheet: Sheet) -> Drawn | None:
    """F15: moves of the global score under thresholds, tolerances and seeds."""
    if not sheet.sweep:
        return None
    figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
    rng = np.random.default_rng(0)
    for row, kind in enumerate(_KINDS):
        delta = np.array([r["delta"] for r in sheet.sweep if r["kind"] == kind])
        axes.plot(delta, row + rng.uniform(-0.22, 0.22, len(delta)), "o", color=BLUE, ms=4, alpha=0.6)
    axes.axvline(0, color=INK, lw=0.8)
    axes.set(yticks=range(len(_KINDS)), yticklabels=_KINDS, xlabel="move of the global score, points")
    return (
        figure,
        "Global score under thresholds ±10 % (common, by category, independent), tolerances ±10 % and other seeds."
        + sheet.note(len(sheet.sweep)),
    )
