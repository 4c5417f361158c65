"""`build.html`: one page that shows what was seen, cut, filled and doubted; it needs neither network nor script."""

from typing import Any

from scene.bore import Bore
from scene.judging.codes import name_span
from scene.judging.drawing import draw_plan, draw_profile, draw_section, draw_strips, text
from scene.judging.judge import Judgement

STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#1f2933;max-width:1060px;margin:24px auto;padding:0 16px}
h1{font-size:24px;margin:0 0 4px}h2{font-size:17px;margin:26px 0 6px;border-bottom:1px solid #d9dee4}
svg{width:100%;height:auto;background:#fbfcfd;border:1px solid #e4e7eb}svg text{font:11px system-ui,sans-serif}
table{border-collapse:collapse;width:100%;font-size:13px}td,th{text-align:left;padding:3px 8px;vertical-align:top;
border-bottom:1px solid #eceff2}.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(190px,1fr));gap:10px}
figure{margin:0}figcaption{font-size:12px;color:#52606d}.warn{background:#fff8e1;border-left:4px solid #e0a800;
padding:6px 10px;margin:6px 0}.grave{background:#fdecea;border-color:#c62828}.good{background:#e9f7ef;
border-left:4px solid #2f855a;padding:6px 10px}.key i{display:inline-block;width:10px;height:10px;border-radius:5px;
margin:0 4px 0 12px}
"""
_KEY = (
    '<p class="key"><i style="background:#9aa5b1"></i>on the model<i style="background:#d64545"></i>inside the bore'
    '<i style="background:#2f6fde"></i>behind the wall<i style="background:#c9a227"></i>beyond the ends</p>'
)
_LEAST_SHOWN = 0.002  # a station whose unexplained share is less makes no picture


def render_page(name: str, bore: Bore, judgement: Judgement, content: dict[str, Any]) -> str:
    """Return the report of a build as HTML; the same build gives the same text.

    `content` has entries of the manifest.
    """
    parts = [
        f"<h1>{text(name)}</h1>",
        f"<p>{bore.length:.2f} m long, {bore.width.mean():.2f} m wide, {bore.height.mean():.2f} m high in the mean. "
        f"{text(judgement.summary().capitalize())}.</p>",
        "<h2>Warnings</h2>", *_warnings(judgement),
        "<h2>Plan</h2>", draw_plan(bore, judgement.returns), _KEY if judgement.returns is not None else "",
        "<h2>Profile</h2>", draw_profile(bore),
    ]  # fmt: skip
    if judgement.stations is not None:
        parts += ["<h2>Station by station</h2>", draw_strips(judgement, bore.length),
                  "<p>The same as numbers is in <code>stations.csv</code>.</p>"]  # fmt: skip
    parts += [*_sections(bore, judgement), *_tables(judgement, content)]
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{text(name)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>'
        f"<body>{''.join(parts)}</body></html>\n"
    )


def _warnings(judgement: Judgement) -> list[str]:
    if not judgement.warnings:
        return ['<p class="good">None: nothing of any size is unexplained, unseen or odd.</p>']
    return [
        f'<p class="warn{" grave" if warning.refuses else ""}">{text(_sentence(warning.text))}</p>'
        for warning in judgement.warnings
    ]


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def _sections(bore: Bore, judgement: Judgement) -> list[str]:
    returns = judgement.returns
    worst = [window for window in judgement.worst if window[2] > _LEAST_SHOWN]
    if returns is None or not worst:
        return []
    figures = [
        f"<figure>{draw_section(bore, returns, start, end)}"
        f"<figcaption>{text(name_span(start, end))}: {share:.1%} unexplained</figcaption></figure>"
        for start, end, share in worst
    ]
    return [
        "<h2>Worst stations</h2><p>Returns over the section that was built, looking ahead.</p>",
        _KEY, f'<div class="grid">{"".join(figures)}</div>',
    ]  # fmt: skip


def _tables(judgement: Judgement, content: dict[str, Any]) -> list[str]:
    removed = [
        (name_span(part["start"], part["end"]), part["cause"], f"{part['points']:,} points", part["warning"])
        for part in content.get("removed", [])
    ]
    places = [
        (name_span(place.start, place.end), "behind the wall" if place.behind else "inside", place.sides, place.look,
         f"{place.returns:,.0f} returns, {place.share:.1%} of those there")
        for place in judgement.places
    ]  # fmt: skip
    unseen = [
        (name_span(piece.start, piece.end), piece.sides, f"{piece.area:.0f} m², {piece.share:.0%} of the girth")
        for piece in (judgement.coverage.pieces if judgement.coverage is not None else ())
    ]
    provenance = sorted(content.get("provenance", {}).items())
    read = [(key.replace("_", " "), value) for key, value in sorted(content.get("detected", {}).items())
            if isinstance(value, str | int | float) and not isinstance(value, bool)]  # fmt: skip
    return [
        make_table("Cut away before fitting", removed), make_table("Unexplained, place by place", places[:20]),
        make_table("Wall that nobody saw", unseen[:20]), make_table("Measured or placed", provenance),
        make_table("How the input was read", read),
    ]  # fmt: skip


def make_table(title: str, rows: list[Any]) -> str:
    """Return a table below its heading; nothing where it has no rows."""
    if not rows:
        return ""
    cells = "".join(f"<tr>{''.join(f'<td>{text(_short(cell))}</td>' for cell in row)}</tr>" for row in rows)
    return f"<h2>{title}</h2><table>{cells}</table>"


def _short(value: Any) -> Any:
    return f"{value:.5g}" if isinstance(value, float) else value
