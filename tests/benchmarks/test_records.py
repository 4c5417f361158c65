"""Results as records, whose tables are rendered and checked; a bore against the truth of its survey."""

import dataclasses
import importlib.util
import json
import re
import shlex
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from benchmarks import records, report
from benchmarks.command import BenchmarkError, run_module
from benchmarks.records import Record, rendered
from benchmarks.truth import Truth, compare, load_truth
from tests.test_docs import command_line  # noqa: F401 (a fixture)

ONE = Record(
    "speed/step", 215.0, "M steps/s", (210.5, 219.0), 8, "control", 0, "one H200", {"jax": "0.11.2"}, "2026-11-26",
    "benchmarks.throughput --out out/speed", "abc", "at least", 15.0,
)  # fmt: skip
PAGE = "before\n<!-- records\n| a | {speed/step} | {speed/step|hardware} |\n-->\nstale\n<!-- /records -->\nafter\n"
GRID = "<!-- records\n{rows: arena|value; dust rock;\nKISS = kiss; dlio}\n-->\n<!-- /records -->"


def test_a_table_is_rendered_from_records_and_only_between_its_marks():
    text = rendered(PAGE, {ONE.id: ONE}, "page.md")
    assert "-->\n| a | 215 M steps/s (210.5-219) | one H200 |\n<!-- /records -->\nafter" in text
    assert text.startswith("before\n<!-- records\n| a | {speed/step} |")
    assert rendered(text, {ONE.id: ONE}, "page.md") == text
    ids = ("arena/kiss/rock", "arena/kiss/dust", "arena/dlio/dust")
    known = {id: dataclasses.replace(ONE, id=id, value=float(k)) for k, id in enumerate(ids)}
    assert "-->\n| KISS | 1 | 0 |\n| dlio | 2 | - |\n<!--" in rendered(GRID, known, "page.md")


@pytest.mark.parametrize(
    ("page", "message"),
    [
        (PAGE.replace("speed/step}", "speed/other}"), r"page.md: there is no record 'speed/other'"),
        (GRID, r"page.md: there is no record arena/kiss/…"),
        (PAGE.replace("|hardware", "|colour"), r"page.md: a record has no 'colour' \(speed/step\)"),
    ],
)
def test_a_record_that_is_missing_is_named_with_its_page(page, message):
    with pytest.raises(BenchmarkError, match=message):
        rendered(page, {ONE.id: ONE}, "page.md")


def test_the_tables_of_all_pages_are_those_of_the_records_on_record():
    assert records.render(write=False) == 0
    assert len(records.on_record()) > 100


def test_records_are_read_as_they_were_written_and_kept_by_family(tmp_path):
    records.write_records(tmp_path / "r.json", [ONE])
    assert records.read_records(tmp_path / "r.json") == [ONE]
    folder = tmp_path / "results"
    records.keep([tmp_path / "r.json"], folder)
    later = dataclasses.replace(ONE, value=230.0)
    records.write_records(tmp_path / "r.json", [later, dataclasses.replace(ONE, id="rays/median")])
    records.keep([tmp_path / "r.json"], folder)
    assert [record.value for record in records.read_records(folder / "speed.json")] == [230.0]
    assert set(records.on_record(folder)) == {"speed/step", "rays/median"}
    with pytest.raises(BenchmarkError, match="two records have the id 'speed/step'"):
        records.write_records(tmp_path / "r.json", [ONE, ONE])


@pytest.mark.parametrize("text", ["{}", "[]", '{"schema": "subterra.records/1", "records": [{"id": "x"}]}', "no"])
def test_a_file_without_records_is_refused(text, tmp_path):
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(BenchmarkError, match=r"r\.json: holds no records"):
        records.read_records(tmp_path / "r.json")


@pytest.mark.parametrize(("bound", "less", "more"), [("near", False, False), ("at least", False, True),
                                                     ("at most", True, False)])  # fmt: skip
def test_a_measurement_beyond_the_tolerance_differs_on_the_sides_of_its_bound(bound, less, more):
    one = dataclasses.replace(ONE, bound=bound)
    assert [one.holds(value) for value in (190.0, 205.0, 225.0, 240.0)] == [less, True, True, more]


@pytest.mark.parametrize(("value", "text"), [(26000.0, "26,000"), (0.33, "0.33"), (99.99, "99.99"), (18, "18")])
def test_a_number_is_shown_with_the_digits_that_it_has(value, text):
    assert records.number(value) == text


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of runpy: the tests have imported the module before
def test_every_record_has_a_command_that_its_module_understands(command_line):  # noqa: F811
    commands = {one.command for one in records.on_record().values() if not one.commit.startswith("until ")}
    for command in sorted(
        {part for one in commands for part in re.split("; (?=benchmarks|train)", one)}
    ):  # trained, then driven
        if command.split()[0] not in ("timeit", "pytest"):
            assert importlib.util.find_spec(command.split()[0]), command
            command_line(shlex.split(command))


def test_measured_figures_are_held_against_those_on_record(tmp_path, capsys):
    records.write_records(tmp_path / "speed.json", [ONE])
    for value, status, verdict in ((205.0, 0, "same"), (190.0, 1, "differs")):
        new = [dataclasses.replace(ONE, value=value), dataclasses.replace(ONE, id="speed/unknown")]
        records.write_records(tmp_path / "out" / "records.json", new)
        assert records.compare([tmp_path / "out" / "records.json"], tmp_path) == status
        assert capsys.readouterr().out == (
            f"speed/step: 215 M steps/s (210.5-219) on record, {value:g} M steps/s (210.5-219) now: {verdict}\n"
        )


def test_a_command_that_fails_is_told_by_the_last_line_of_its_log(tmp_path):
    ran = run_module("json.tool", tmp_path / "nowhere.json", log=tmp_path / "log.txt")
    assert ran.status != 0
    assert "nowhere.json" in ran.message
    (tmp_path / "one.json").write_text("1")
    assert run_module("json.tool", tmp_path / "one.json", log=tmp_path / "log.txt").message == ""


@pytest.mark.parametrize(("shift", "wider", "longer"), [((0.0, 0.0, 0.0), 0.0, 0.0), ((0.0, 0.03, -0.04), 0.05, 1.0)])
def test_a_shifted_wider_longer_bore_is_off_by_just_that(tmp_path, shift, wider, longer):
    station, origin = np.arange(0.0, 40.01, 0.25), [100.0, 50.0, 7.0]
    sizes = {"station": station.tolist(), "width": [5.65] * len(station), "height": [6.36] * len(station)}
    place = lambda along: np.column_stack([along, np.zeros((len(along), 2))])  # noqa: E731
    truth = {"schema": "subterra.truth/1", **sizes, "position": (place(station) + origin).tolist()}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    (tmp_path / "manifest.json").write_text(json.dumps({"frame": {"origin": origin}}))
    along = np.arange(0.0, 40.01 + longer, 0.25)
    size = {"width": np.full(len(along), 5.65 + wider), "height": np.full(len(along), 6.36)}
    np.savez(tmp_path / "bore.npz", station=along, position=place(along) + shift, **size)
    found = compare(tmp_path, load_truth(tmp_path / "truth.json"))
    figures = found.figures()
    assert [*figures] == ["centreline_rmse", "width_rmse", "height_rmse", "length_error"]
    np.testing.assert_allclose([*figures.values()], [np.hypot(*shift[1:]), wider, 0.0, longer], atol=1e-4)
    np.testing.assert_allclose(found.lateral, shift[1], atol=1e-4)
    np.testing.assert_allclose(found.vertical, shift[2], atol=1e-4)


def test_a_file_of_another_schema_is_refused(tmp_path):
    (tmp_path / "t.json").write_text(json.dumps({"schema": "x"}))
    with pytest.raises(ValueError, match="schema is x"):
        load_truth(tmp_path / "t.json")


def test_the_demos_report_scales_and_judges_figures_and_refers_to_nothing_outside_itself(tmp_path, monkeypatch):
    station = np.arange(0.0, 20.5, 0.5)
    bend = np.stack([station, 0.01 * station**2, 7.0 + 0.02 * station], axis=1)
    judged = {"warnings": ["<a>"], "share": {"explained": 0.9876}, "returns": 2.5e6, "tolerance": 0.05}
    manifest = {"judgement": judged | {"wall_seen": 0.7}, "frame": {"origin": [0.0, 0.0, 0.1]}}
    for folder in ("training", "scene"):
        (tmp_path / folder).mkdir()
    (tmp_path / "film.webp").write_bytes(b"RIFF0000WEBPVP8 ")
    (tmp_path / "training" / "curve.png").write_bytes(report.png_bytes(plt.figure(), 10))
    (tmp_path / "scene" / "manifest.json").write_text(json.dumps(manifest))
    np.savez(tmp_path / "scene" / "bore.npz", station=station, position=bend)
    monkeypatch.setattr(report, "picture", lambda *_: np.zeros((4, 4, 3), np.uint8))
    monkeypatch.setattr(report, "png_bytes", lambda figure, dpi: figures.append(figure) or b"")
    figures = []
    summary = {row.key: 0.9 for row in report._ROWS} | {"task": "A-v1", "stage_seconds": {"survey": 12.34}}
    summary |= {"width_rmse": 0.0399, "height_rmse": 0.0401, "coverage_mean_100": 0.901, "train_steps": 9e5}
    text = report.write_report(tmp_path, summary, Truth(station, bend, station, station)).read_text()
    assert re.findall(r'src="data:image/(\w+)', text) == ["webp", "png", "png", "png"]
    assert (text.count("src="), text.count("http")) == (4, 0)
    rows = re.findall('<tr class="(met|missed)">(.*?)</tr>', text)
    said = [" ".join([word, *re.findall(r"<td[^>]*>([^<]*)", row)]).rstrip() for word, row in rows]
    said += [re.search(r"The builder's judge.*?<|The builder&#x27;s judge.*?<", text)[0]]
    assert said == Path(__file__).with_name("report.txt").read_text().splitlines()
    (true, built), (side, above) = (axes.lines for axes in figures[0].axes)
    np.testing.assert_allclose(np.linalg.norm(true.get_xydata(), axis=1), np.linalg.norm(bend[:, :2], axis=1))
    np.testing.assert_allclose(true.get_xydata()[-1, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(built.get_xydata(), true.get_xydata())
    np.testing.assert_allclose([side.get_ydata(), above.get_ydata() - 0.1], [0.02 * station] * 2, atol=1e-9)
