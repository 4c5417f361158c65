"""Results as records, and the tables of the documentation rendered from them.

`python -m benchmarks.records render` writes the tables of all pages anew; `check` fails where a
record is missing or a page is stale; `keep out/board/records.json` takes records over into
`benchmarks/results/`, a file for each family (the first word of an id); `compare` says which
figures of such files differ from those on record.

A record is one figure. Commands write theirs to `records.json` beside their other results. A page
holds a table's template in a comment, with ids in braces, and the rendered table behind it. A line
`{board: SPLIT}` is the board's tables by kind, `{board: screen}` its table of all tasks, `{board:
given}` without those of a hidden start; `{rows: FAMILY; COLUMN COLUMN; LABEL = ROW; ROW}` a line
for each row, of the records `FAMILY/ROW/COLUMN`, with a dash where one was not measured.
"""

import dataclasses
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

from benchmarks.command import BenchmarkError
from benchmarks.results import UNKNOWN, environment_facts, write_file
from subterra_jax.host.command import INPUT_ERRORS, run_command

ROOT = Path(__file__).parents[1]
FOLDER = Path(__file__).parent / "results"
SCHEMA = "subterra.records/1"
_VERSIONS = ("python", "jax", "numpy", "subterra-jax")
_BLOCK = re.compile(r"<!-- records\n(.*?)-->\n(.*?)<!-- /records -->", re.DOTALL)
_FIGURE = re.compile(r"\{([\w.+-]+(?:/[\w.+-]+)+)(?:\|(\w+))?\}")
_BOARD = re.compile(r"\{board: ([\w-]+)\}\n")
_ROWS = re.compile(r"\{rows: ([\w-]+)(\|\w+)?;([^;}]+);([^}]+)\}")
_ID = re.compile(r"[\w.+-]+(/[\w.+-]+)+")


@dataclasses.dataclass(frozen=True)
class Record:
    """One figure and where it comes from."""

    id: str  # Its name, `FAMILY/…/QUANTITY`
    value: float  # The figure, rounded to the digits that are shown
    unit: str  # Its unit; empty for a pure number
    interval: tuple[float, float] | None  # Its 95 % interval; None where none was determined
    n: int | None  # Episodes, surveys or runs behind it; None for a single measurement
    split: str  # Tunnels, scenes or seeds that it was measured on, in words
    seed: int | None  # Seed of the measurement; None where there are several or none
    hardware: str  # Machine
    versions: dict[str, str]  # Versions of Python and packages
    date: str  # Day of the measurement
    command: str  # Words after `python -m`
    # Commit that was measured; `unknown` where it was not kept, as before 26 November 2026; `until X` where the program
    # of the command is no part of the tree after commit X
    commit: str
    # Whether a measurement again must be near it, or may be larger (`at least`) or smaller (`at most`)
    bound: Literal["near", "at least", "at most"] = "near"
    tolerance: float = 0.0  # Difference in the wrong direction that is none, in its unit

    def holds(self, measured: float) -> bool:
        """Tell whether a measurement agrees with it."""
        difference = measured - self.value
        too_large = difference > self.tolerance + 1e-9 and self.bound != "at least"
        too_small = -difference > self.tolerance + 1e-9 and self.bound != "at most"
        return not (too_large or too_small)

    @property
    def text(self) -> str:
        """The figure with unit and interval, as tables show it."""
        unit = f" {self.unit}" if self.unit else ""
        ends = "" if self.interval is None else f" ({number(self.interval[0])}-{number(self.interval[1])})"
        return f"{number(self.value)}{unit}{ends}"


def number(value: float) -> str:
    """Return a number with commas between thousands and no digits that are not there."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.6g}"


def measured(id: str, value: float, unit: str, command: str, **further: Any) -> Record:
    """Return the record of what was measured here and now.

    Args:
        id: As in `Record`.
        value: The figure.
        unit: Its unit.
        command: Words after `python -m`.
        **further: Other fields of `Record`; `interval`, `n`, `split` and `seed` are empty if not given.
    """
    fields = {"interval": None, "n": None, "split": "", "seed": None, **further}
    return Record(id, value, unit, command=command, **of_facts(environment_facts()), **fields)


def of_facts(facts: dict[str, Any]) -> dict[str, Any]:
    """Return hardware, versions, date and commit of a record from what `environment_facts` returned."""
    hardware = facts["device"] if facts["platform"] != "cpu" else f"{facts['cpu_cores']} CPU cores"
    versions = {name: str(facts[name]) for name in _VERSIONS if facts.get(name)}
    commit = facts.get("commit") or UNKNOWN
    return {"hardware": hardware, "versions": versions, "date": facts["date"][:10], "commit": commit}


def write_records(path: Path, records: Iterable[Record]) -> None:
    """Write records, one a line.

    Raises:
        BenchmarkError: Two have the same id.
    """
    records = list(records)
    if len({record.id for record in records}) < len(records):
        ids = [record.id for record in records]
        raise BenchmarkError(f"{path}: two records have the id {next(id for id in ids if ids.count(id) > 1)!r}")
    lines = ",\n".join(json.dumps(dataclasses.asdict(record), ensure_ascii=False) for record in records)
    write_file(path, f'{{"schema": "{SCHEMA}", "records": [\n{lines}\n]}}\n'.encode())


def read_records(path: Path) -> list[Record]:
    """Read a file of records.

    Raises:
        BenchmarkError: It is none.
    """
    try:
        content = json.loads(path.read_text())
        if content["schema"] != SCHEMA:
            raise BenchmarkError(f"{path}: has the schema {content['schema']!r}, needed is {SCHEMA!r}")
        found = []
        for fields in content["records"]:
            ends = fields.pop("interval")
            found.append(Record(**fields, interval=None if ends is None else (ends[0], ends[1])))
            if not _ID.fullmatch(found[-1].id):
                raise BenchmarkError(f"{path}: {found[-1].id!r} is no id of a record: FAMILY/QUANTITY")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BenchmarkError(f"{path}: holds no records ({error})") from error
    return found


def on_record(folder: Path = FOLDER) -> dict[str, Record]:
    """Return all records by id.

    Raises:
        BenchmarkError: A file is damaged, or two records have the same id.
    """
    found: dict[str, Record] = {}
    for path in sorted(folder.glob("*.json")):
        for record in read_records(path):
            if record.id in found:
                raise BenchmarkError(f"{path}: there is a record {record.id!r} already")
            found[record.id] = record
    return found


def keep(paths: Sequence[Path], folder: Path = FOLDER) -> None:
    """Take records over: each replaces the one of its id, in the file of its family."""
    for path in paths:
        fresh = read_records(path)
        for family in sorted({record.id.partition("/")[0] for record in fresh}):
            file = folder / f"{family}.json"
            kept = {record.id: record for record in read_records(file)} if file.exists() else {}
            kept |= {record.id: record for record in fresh if record.id.partition("/")[0] == family}
            write_records(file, sorted(kept.values(), key=lambda record: record.id))
            print(file)


def compare(paths: Sequence[Path], folder: Path = FOLDER) -> int:
    """Print measured figures beside those on record; return 1 where one differs."""
    records, status = on_record(folder), 0
    for record in (record for path in paths for record in read_records(path)):
        if (known := records.get(record.id)) is not None:
            same = known.holds(record.value)
            status |= not same
            print(f"{record.id}: {known.text} on record, {record.text} now: {'same' if same else 'differs'}")
    return status


def rendered(text: str, records: dict[str, Record], page: str) -> str:
    """Return a page with its tables rendered from records.

    Args:
        text: The page.
        records: Records by id.
        page: Name of the page, for messages.

    Raises:
        BenchmarkError: A record is missing.
    """

    def figure(found: re.Match[str]) -> str:
        id, field = found.groups()
        if id not in records:
            raise BenchmarkError(f"{page}: there is no record {id!r} in {FOLDER.name}/")
        if field is None:
            return records[id].text
        if field not in {one.name for one in dataclasses.fields(Record)}:
            raise BenchmarkError(f"{page}: a record has no {field!r} ({id})")
        value = getattr(records[id], field)
        return number(value) if isinstance(value, float) else str(value)

    def rows(found: re.Match[str]) -> str:
        family, field, columns, names = found.groups(default="")
        lines = []
        for label, _, name in (row.strip().partition(" = ") for row in names.split(";")):
            ids = [f"{family}/{name or label}/{column}" for column in columns.split()]
            if not records.keys() & ids:
                raise BenchmarkError(f"{page}: there is no record {family}/{name or label}/… in {FOLDER.name}/")
            cells = [f"{{{id}{field}}}" if id in records else "-" for id in ids]
            lines.append(f"| {' | '.join([label, *cells])} |")
        return "\n".join(lines)

    def block(found: re.Match[str]) -> str:
        template = found[1]
        text = _ROWS.sub(rows, _BOARD.sub(lambda split: board(split[1]), template))
        return f"<!-- records\n{template}-->\n{_FIGURE.sub(figure, text)}<!-- /records -->"

    return _BLOCK.sub(block, text)


def board(split: str) -> str:
    """Return tables of the board's cells on record: by kind of lining in one split, or the one of a `screen`."""
    from benchmarks.board.cells import read_cells  # with JAX, which the other pages do without
    from benchmarks.board.tables import kinds_markdown, screen_markdown

    cells = read_cells(FOLDER.parent / "board" / "cells.jsonl")
    if split == "given":
        return screen_markdown([cell for cell in cells if not cell["hidden_start"]])
    return screen_markdown(cells) if split == "screen" else kinds_markdown(cells, split)


def render(write: bool) -> int:
    """Render the tables of all pages.

    Args:
        write: Write them; otherwise only say which are stale.

    Returns:
        0, or 1 where a page is stale and was not written.
    """
    records, stale = on_record(), []
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = page.read_text()
        name = str(page.relative_to(ROOT))
        if (fresh := rendered(text, records, name)) != text:
            stale.append(name)
            if write:
                write_file(page, fresh.encode())
    for name in stale:
        print(f"{name}: {'rendered' if write else 'is stale; run python -m benchmarks.records render'}")
    return int(bool(stale) and not write)


def main(words: list[str] | None = None) -> int:
    """Runs the command line: `render`, `check`, `keep FILE…` or `compare FILE…`; returns 2 for a user's mistake."""
    command, *rest = (sys.argv[1:] if words is None else words) or [""]
    commands: dict[str, Callable[[], int | None]] = {
        "render": lambda: render(write=True),
        "check": lambda: render(write=False),
        "keep": lambda: keep([Path(word) for word in rest]),
        "compare": lambda: compare([Path(word) for word in rest]),
    }
    if command in ("-h", "--help"):
        print(__doc__)
        return 0
    if command not in commands:
        print(f"error: say one of {', '.join(commands)}; --help says what they do", file=sys.stderr)
        return 2
    return run_command(commands[command], "interrupted", INPUT_ERRORS)


if __name__ == "__main__":
    sys.exit(main())
