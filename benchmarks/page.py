"""One self-contained HTML page: headings, figures and tables, no file or address outside itself."""

import base64
import html
import io
from collections.abc import Iterable

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

_STYLE = """
:root { color-scheme: light dark; --ink: #1d2b36; --line: #d5dbe1; --soft: #f4f6f8; --paper: #ffffff; }
@media (prefers-color-scheme: dark) { :root { --ink: #dfe6ec; --line: #3a4753; --soft: #1c252d; --paper: #131a20; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 68rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: .2rem; }
h2 { margin-top: 2.4rem; border-bottom: 1px solid var(--line); padding-bottom: .2rem; }
figure { margin: 1rem 0; }
figure img { width: 100%; background: #fff; border: 1px solid var(--line); border-radius: 6px; }
figcaption, .note { color: color-mix(in srgb, var(--ink) 70%, transparent); font-size: .92rem; }
table { border-collapse: collapse; width: 100%; } th, td { text-align: left; padding: .35rem .6rem; }
th, td { border-bottom: 1px solid var(--line); }
th.number, td.number { text-align: right; font-variant-numeric: tabular-nums; }
tr.missed td { background: color-mix(in srgb, #c1121f 14%, transparent); }
.simulated { display: inline-block; background: var(--soft); border: 1px solid var(--line);
  border-radius: 4px; padding: 0 .5rem; }
"""


def page(title: str, parts: Iterable[str]) -> str:
    """The whole page."""
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>'
        f"<body>\n{body}\n</body></html>\n"
    )


def heading(text: str, level: int = 2) -> str:
    """A heading; the text is escaped."""
    return f"<h{level}>{html.escape(text)}</h{level}>"


def paragraph(text: str, kind: str = "note") -> str:
    """A paragraph; the text is escaped."""
    return f'<p class="{kind}">{html.escape(text)}</p>'


def figure(content: Figure | np.ndarray | bytes, caption: str) -> str:
    """A figure, an `(h, w, 3)` picture or PNG bytes, embedded."""
    data = base64.b64encode(_png(content)).decode()
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def table(columns: tuple[str, ...], rows: Iterable[tuple[tuple[str, ...], bool]]) -> str:
    """A table of strings; a row's flag marks it as missing its goal. The second column is set as numbers."""
    kinds = ["number" if k == 1 else "text" for k in range(len(columns))]
    head = "".join(f'<th class="{kind}">{html.escape(name)}</th>' for kind, name in zip(kinds, columns, strict=True))
    lines = []
    for cells, missed in rows:
        data = "".join(f'<td class="{kind}">{html.escape(cell)}</td>' for kind, cell in zip(kinds, cells, strict=True))
        lines.append(f'<tr class="{"missed" if missed else "met"}">{data}</tr>')
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _png(content: Figure | np.ndarray | bytes) -> bytes:
    if isinstance(content, bytes):
        return content
    buffer = io.BytesIO()
    if isinstance(content, Figure):
        content.savefig(buffer, format="png", dpi=130)
    else:
        Image.fromarray(content).save(buffer, format="png")
    return buffer.getvalue()
