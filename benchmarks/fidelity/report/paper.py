"""The paper's own numbers beside ours, each with the class of its evidence."""

from typing import Any

from benchmarks.fidelity.judge import Judgement

SOURCE = "Subterra: An Open-Source Validated Benchmark for GNSS-Denied Tunnel Navigation"


def rows(judgement: Judgement, controls: list[dict[str, Any]] | None = None) -> list[dict[str, Any]]:
    """One row a number: what it is, the paper's, ours, unit, evidence class and what it says."""
    base = judgement.values["base"]
    scored = judgement.scored["base"]

    def ours(id: str, factor: float = 1.0) -> float | None:
        value = base[id].value
        return None if value is None else factor * value

    null = judgement.scored["null"].overall
    return [
        _row("global score", 97.1, scored.overall, "%", "mixed",
             f"over {scored.evaluated} of {len(scored.categories)} categories; the null tube has {_text(null)}"),
        _row("categories / metrics", "18 / 199", f"{len(scored.categories)} / {len(base)}", "", "-", "same counts"),
        _row("cloud to mesh, mean, cloud cast in the same mesh", 2.46, ours("selfcast_p2s_mean", 100.0), "cm", "C",
             "by construction: range noise alone, alike for any mesh; logged, never scored"),
        _row("the same within 10 cm", 97.5, ours("selfcast_within_10cm", 100.0), "%", "C", "by construction, as above"),
        _row("cloud to mesh, mean, held-out points", 2.46, ours("c2m_mean", 100.0), "cm", "H",
             "the comparable claim, on points that the builder never read"),
        _row("the same within 10 cm", 97.5, ours("c2m_within_10cm", 100.0), "%", "H", "held-out points"),
        _row("the same, null tube", None, _of(judgement, "null", "c2m_mean", 100.0), "cm", "H",
             "what a constant tube on the right axis gets"),
    ]  # fmt: skip


def _row(what: str, paper: Any, here: Any, unit: str, evidence: str, note: str) -> dict[str, Any]:
    return {"what": what, "paper": paper, "here": here, "unit": unit, "evidence": evidence, "note": note}


def _of(judgement: Judgement, name: str, id: str, factor: float) -> float | None:
    value = judgement.values[name][id].value
    return None if value is None else factor * value


def _text(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"
