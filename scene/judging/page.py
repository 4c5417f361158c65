"""`build.html`: one page that shows what was seen, cut, filled and doubted; it needs neither network nor script.

Its drawings are SVG: plan, profile, strips along the bore, and sections with the returns over them.
"""

from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.bore import Bore
from scene.judging.judge import Judgement
from scene.judging.places import BEHIND, BEYOND, EXPLAINED, INSIDE, Returns, name_span

COLOURS = {EXPLAINED: "#9aa5b1", INSIDE: "#d64545", BEHIND: "#2f6fde", BEYOND: "#c9a227"}
_WALL = "#111827"
_WIDTH = 1000  # of a drawing along the bore, in units of the picture
_MARGIN = 45  # units of the picture
_PLAN_POINTS, _SECTION_POINTS = 6000, 1500  # of each picture, so that the page stays light
_SEEN_AROUND = 2.0  # m beyond the wall that a section's picture shows


def draw_plan(bore: Bore, returns: Returns | None) -> str:
    """Return the plan, turned so that the bore lies across the page, with the returns by their kind."""
    plan = bore.position[:, :2]
    run = plan[-1] - plan[0]
    turn = np.arctan2(run[1], run[0])
    rotate = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    half = bore.width[:, None] / 2 * bore.lateral[:, :2]
    walls = [(plan + half) @ rotate, (plan - half) @ rotate]
    points, kinds = np.empty((0, 2)), np.empty(0, int)
    if returns is not None:
        rows = _sample(len(returns.kind), _PLAN_POINTS)
        points, kinds = _plan_points(bore, returns, rows) @ rotate, returns.kind[rows]
    line = plan @ rotate
    both = np.concatenate(walls)
    low, high = both.min(axis=0) - 6.0, both.max(axis=0) + 6.0
    inside = ((points > low) & (points < high)).all(axis=1) if len(points) else np.empty(0, bool)
    scale = (_WIDTH - 2 * _MARGIN) / (high[0] - low[0])
    height = (high[1] - low[1]) * scale + 30

    def place(xy: np.ndarray) -> np.ndarray:
        return np.column_stack([_MARGIN + (xy[:, 0] - low[0]) * scale, (high[1] - xy[:, 1]) * scale + 5])

    parts = [_dots(place(points[inside & (kinds == kind)]), colour, 1.4) for kind, colour in COLOURS.items()]
    parts += [_polyline(place(wall), _WALL, 1.2) for wall in walls]
    parts.append(_polyline(place(line), _WALL, 0.6, "6 4"))
    for station in _ticks(bore.length):
        at = place(np.stack([np.interp([station], bore.station, line[:, k]) for k in (0, 1)], axis=1))[0]
        parts.append(f'<text x="{at[0]:.0f}" y="{height - 6:.0f}" text-anchor="middle">{station:g} m</text>')
    north = np.array([0.0, 1.0]) @ rotate
    parts.append(_arrow(_WIDTH - 32, 28, north))
    return _svg(_WIDTH, height, parts)


def draw_profile(bore: Bore) -> str:
    """Return heights of floor, axis and crown over the station; heights are drawn larger than lengths."""
    down, up = (int(np.argmin(np.abs(bore.angle - angle))) for angle in (-np.pi / 2, np.pi / 2))
    z = bore.position[:, 2]
    floor, crown = z - bore.radius[:, down] * bore.up[:, 2], z + bore.radius[:, up] * bore.up[:, 2]
    low, high = float(floor.min()) - 0.5, float(crown.max()) + 0.5
    height = 190

    def place(values: np.ndarray) -> np.ndarray:
        across = _MARGIN + bore.station / bore.length * (_WIDTH - 2 * _MARGIN)
        return np.column_stack([across, 10 + (high - values) / (high - low) * (height - 40)])

    parts = [_polyline(place(values), _WALL, width, dash)
             for values, width, dash in ((floor, 1.6, ""), (z, 0.6, "6 4"), (crown, 1.6, ""))]  # fmt: skip
    for value in np.linspace(low + 0.5, high - 0.5, 3):
        y = 10 + (high - value) / (high - low) * (height - 40)
        parts.append(f'<text x="{_MARGIN - 5}" y="{y + 4:.0f}" text-anchor="end">{value:.1f} m</text>')
    return _svg(_WIDTH, height, [*parts, *_station_axis(bore.length, height)])


def draw_section(bore: Bore, returns: Returns, start: float, end: float) -> str:
    """Return the section in the middle of some stations, with the returns between them over it."""
    row = int(bore.row_of((start + end) / 2))
    wall = np.stack([bore.radius[row] * np.cos(bore.angle), bore.radius[row] * np.sin(bore.angle)], axis=1)
    low, high = wall.min(axis=0) - _SEEN_AROUND, wall.max(axis=0) + _SEEN_AROUND
    size = 300
    scale = size / float((high - low).max())

    def place(points: np.ndarray) -> np.ndarray:  # left is drawn left, as one sees it looking ahead
        return np.column_stack([(high[0] - points[:, 0]) * scale, (high[1] - points[:, 1]) * scale])

    here = np.flatnonzero((returns.station >= start) & (returns.station <= end))
    points = np.column_stack([returns.lateral[here], returns.upward[here]])
    near = ((points > low) & (points < high)).all(axis=1)
    here, points = here[near], points[near]
    pick = _sample(len(here), _SECTION_POINTS)
    parts = [_dots(place(points[pick][returns.kind[here[pick]] == kind]), colour, 2.0)
             for kind, colour in COLOURS.items()]  # fmt: skip
    outline = np.concatenate([wall, wall[:1]])
    parts.append(_polyline(place(outline), _WALL, 1.2))
    across, tall = (high - low) * scale
    parts.append(f'<path d="M8 {tall - 8:.0f}h{scale:.1f}" stroke="#111" stroke-width="2"/>')
    parts.append(f'<text x="8" y="{tall - 12:.0f}">1 m</text>')
    return _svg(float(across), float(tall), parts)


def _plan_points(bore: Bore, returns: Returns, rows: np.ndarray) -> Float[np.ndarray, "k 2"]:
    at = bore.row_of(returns.station[rows])
    along = returns.station[rows] - bore.station[at]
    return (
        bore.position[at, :2] + along[:, None] * bore.tangent[at, :2]
        + returns.lateral[rows][:, None] * bore.lateral[at, :2]
    )  # fmt: skip


def _sample(count: int, most: int) -> np.ndarray:
    """Rows spread evenly over a count, `most` of them."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).astype(np.intp)


def _ticks(length: float) -> np.ndarray:
    step = next(s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 1e9) if length / s <= 10)
    return np.arange(0.0, length + 1e-9, step)


def _station_axis(length: float, height: float) -> list[str]:
    scale = (_WIDTH - 2 * _MARGIN) / length
    return [
        f'<text x="{_MARGIN + s * scale:.0f}" y="{height - 6:.0f}" text-anchor="middle">{s:g} m</text>'
        for s in _ticks(length)
    ]


def _polyline(points: np.ndarray, colour: str, width: float, dash: str = "") -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return f'<polyline points="{text}" fill="none" stroke="{colour}" stroke-width="{width}"{dashes}/>'


def _dots(points: np.ndarray, colour: str, size: float) -> str:
    if not len(points):
        return ""
    text = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
    return f'<path d="{text}" stroke="{colour}" stroke-width="{size}" stroke-linecap="round" fill="none"/>'


def _arrow(x: float, y: float, direction: np.ndarray) -> str:
    dx, dy = 14 * direction[0], -14 * direction[1]
    return (
        f'<path d="M{x - dx:.1f} {y - dy:.1f}L{x + dx:.1f} {y + dy:.1f}" stroke="#111"/>'
        f'<circle cx="{x + dx:.1f}" cy="{y + dy:.1f}" r="2.5"/>'
        f'<text x="{x + 1.7 * dx:.1f}" y="{y + 1.7 * dy + 4:.1f}" text-anchor="middle">y</text>'
    )


def _svg(width: float, height: float, parts: list[str]) -> str:
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img">{"".join(parts)}</svg>'


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
_NO_WARNING = '<p class="good">None: nothing of any size is unexplained, unseen or odd.</p>'
_NO_RETURNS = '<p class="good">None on its shape and sizes. Nothing was seen between the rings that could be odd.</p>'
_KEY = (
    '<p class="key"><i style="background:#9aa5b1"></i>on the model<i style="background:#d64545"></i>inside the bore'
    '<i style="background:#2f6fde"></i>behind the wall<i style="background:#c9a227"></i>beyond the ends</p>'
)
_LEAST_SHOWN = 0.002  # a station whose unexplained fraction is less makes no picture


def render_page(name: str, bore: Bore, judgement: Judgement, content: dict[str, Any]) -> str:
    """Return the report of a build as HTML; the same build gives the same text.

    `content` has entries of the manifest.
    """
    shown = [(" grave" if one.refuses else "", f"{one.text[:1].upper()}{one.text[1:]}.") for one in judgement.warnings]
    warnings = [f'<p class="warn{grave}">{escape(words)}</p>' for grave, words in shown]
    parts = [
        f"<h1>{escape(name)}</h1>",
        f"<p>{bore.length:.2f} m long, {bore.width.mean():.2f} m wide, {bore.height.mean():.2f} m high in the mean. "
        f"{escape(judgement.summary().capitalize())}.</p>",
        "<h2>Warnings</h2>", *(warnings or [_NO_WARNING if judgement.returns is not None else _NO_RETURNS]),
        "<h2>Plan</h2>", draw_plan(bore, judgement.returns), _KEY if judgement.returns is not None else "",
        "<h2>Profile</h2>", draw_profile(bore),
    ]  # fmt: skip
    parts += [*_sections(bore, judgement), *_tables(judgement, content)]
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(name)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>'
        f"<body>{''.join(parts)}</body></html>\n"
    )


def _sections(bore: Bore, judgement: Judgement) -> list[str]:
    returns = judgement.returns
    worst = [window for window in judgement.worst if window[2] > _LEAST_SHOWN]
    if returns is None or not worst:
        return []
    figures = [
        f"<figure>{draw_section(bore, returns, start, end)}"
        f"<figcaption>{escape(name_span(start, end))}: {fraction:.1%} unexplained</figcaption></figure>"
        for start, end, fraction in worst
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
        (name_span(place.start, place.end), "behind the wall" if place.behind else "inside", place.sides,
         f"{place.low:.1f} to {place.high:.1f} m above the floor",
         f"{place.returns:,.0f} returns, {place.fraction:.1%} of those there")
        for place in judgement.places
    ]  # fmt: skip
    unseen = [
        (name_span(patch.start, patch.end), patch.sides, f"{patch.area:.0f} m², {patch.fraction:.0%} of the girth")
        for patch in (judgement.coverage.patches if judgement.coverage is not None else ())
    ]
    provenance = sorted(content.get("provenance", {}).items())
    detected = sorted(content.get("detected", {}).items())
    read = [(key.replace("_", " "), _with_unit(key, value)) for key, value in detected
            if isinstance(value, str | int | float) and not isinstance(value, bool)]  # fmt: skip
    return [
        make_table("Cut away before fitting", removed), make_table("Unexplained, place by place", places[:20]),
        make_table("Wall that nobody saw", unseen[:20]), make_table("Measured or placed", provenance),
        make_table("How the input was read", read),
    ]  # fmt: skip


# Units of what a manifest says was detected, by the ends of the names; the first that fits. The others have none.
_UNITS = {"clock_offset": "s", "offset": "m", "rms": "m", "radius": "m", "radius_mean": "m", "radius_sd": "m",
          "thickness": "m", "in_a_sweep": "m", "chainage_start": "m"}  # fmt: skip


def _with_unit(key: str, value: Any) -> Any:
    unit = next((unit for end, unit in _UNITS.items() if key.endswith(end)), "")
    return f"{value:.5g} {unit}".strip() if isinstance(value, float) else value


def make_table(title: str, rows: list[Any]) -> str:
    """Return a table below its heading; nothing where it has no rows."""
    if not rows:
        return ""
    shown = [[f"{cell:.5g}" if isinstance(cell, float) else escape(str(cell)) for cell in row] for row in rows]
    cells = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in shown)
    return f"<h2>{title}</h2><table>{cells}</table>"
