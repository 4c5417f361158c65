"""Results as records: tables are rendered from them, one that is missing or differs is noticed."""

import dataclasses
import importlib.util
import json
import math
import shlex

import pytest

from benchmarks import records, reproduce
from benchmarks.command import BenchmarkError, run_module
from benchmarks.records import Record, rendered
from tests.test_docs import command_line  # noqa: F401 (a fixture)

ONE = Record(
    "speed/step", 215.0, "M steps/s", (210.5, 219.0), 8, "control", 0, "one H200", {"jax": "0.11.2"}, "2026-11-26",
    "benchmarks.throughput --out out/speed", "abc", "at least", 15.0,
)  # fmt: skip
PAGE = "before\n<!-- records\n| a | {speed/step} | {speed/step|hardware} |\n-->\nstale\n<!-- /records -->\nafter\n"


def test_a_table_is_rendered_from_records_and_only_between_its_marks():
    text = rendered(PAGE, {ONE.id: ONE}, "page.md")
    assert "-->\n| a | 215 M steps/s (210.5-219) | one H200 |\n<!-- /records -->\nafter" in text
    assert text.startswith("before\n<!-- records\n| a | {speed/step} |")
    assert rendered(text, {ONE.id: ONE}, "page.md") == text


@pytest.mark.parametrize(
    ("page", "message"),
    [
        (PAGE.replace("speed/step}", "speed/other}"), r"page.md: there is no record 'speed/other'"),
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
    words = {record.command for record in records.on_record().values()}
    words |= {word.format(out="out", shared="shared") for job in reproduce.JOBS.values() for word in job.commands}
    for command in sorted(words):
        if command.split()[0] not in ("timeit", "pytest"):
            assert importlib.util.find_spec(command.split()[0]), command
            command_line(shlex.split(command))


def test_what_is_there_is_not_measured_again_and_is_held_against_the_records(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "150")
    manifest = tmp_path / "metro" / "scene" / "manifest.json"
    manifest.parent.mkdir(parents=True)
    for length, status, result in ((1283.732, 0, "same"), (1290.0, 1, "differs")):
        manifest.write_text(json.dumps({"bore": {"length": length}}))
        assert reproduce.main(["--jobs", "metro", "--out", str(tmp_path)]) == status
        output = capsys.readouterr().out
        assert result in output
        assert "python -m benchmarks.b2 --robots 8192" in output
    assert json.loads((tmp_path / "reproduce.json").read_text())["rows"][0]["measured"] == 1290.0


def test_a_job_that_fails_names_its_log_and_one_without_its_input_is_left_out(tmp_path):
    missing = reproduce.Job(("scene.build x",), 1.0, needs="{shared}/nowhere")
    assert reproduce.run_job(missing, tmp_path / "a", tmp_path) is None
    failing = reproduce.Job(("json.tool nowhere.json",), 1.0)
    with pytest.raises(BenchmarkError, match=r"log.txt: python -m json.tool ended with status"):
        reproduce.run_job(failing, tmp_path / "b", tmp_path)


def test_a_command_that_fails_is_told_by_the_last_line_of_its_log(tmp_path):
    ran = run_module("json.tool", tmp_path / "nowhere.json", log=tmp_path / "log.txt")
    assert ran.status != 0
    assert "nowhere.json" in ran.message
    (tmp_path / "one.json").write_text("1")
    assert run_module("json.tool", tmp_path / "one.json", log=tmp_path / "log.txt").message == ""


def test_the_worst_of_all_dirty_clouds_is_the_record_and_a_refused_one_has_none():
    from benchmarks.dirty.__main__ import records_of

    built = {"wall_mean": -0.004, "wall_near": 0.998, "width": 0.02, "floor_worst": 0.1}
    refused = dict.fromkeys(built, float("nan"))
    found = {one.id: (one.value, one.n) for one in records_of([built, refused, {**built, "wall_mean": 0.003}])}
    assert found["dirty/wall-mean"] == (0.4, 2)
    assert found["dirty/wall-within-10-cm"] == (99.8, 2)
    assert records_of([refused]) == []


def test_the_figures_of_a_reconstruction_are_records_of_its_first_seed():
    from benchmarks.reconstruction import FIGURES, ReconstructionConfig, records_of

    row = {
        "poses": "given",
        **dict.fromkeys(FIGURES, 0.01),
        "length_error": -0.02,
        "seconds": 90.0,
        "gauge_error": math.nan,
    }
    found = {
        one.id: one.value for one in records_of(ReconstructionConfig((7, 8)), [{**row, "seed": s} for s in (7, 8)])
    }
    assert found["reconstruction/given/centreline"] == 1.0
    assert found["reconstruction/given/length"] == 0.02
    assert found["reconstruction/given/time"] == 1.5
    assert "reconstruction/given/gauge" not in found, "what was not measured is no figure"
    assert FIGURES["hold_within_10cm"].met(0.98, "given")
    assert not FIGURES["hold_within_10cm"].met(0.97, "given")
    assert not FIGURES["gauge_error"].met(-0.004, "given")
    assert not FIGURES["gauge_error"].met(math.nan, "control")
