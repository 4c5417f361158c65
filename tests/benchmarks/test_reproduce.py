"""Every number of the tables of results is claimed, and a number that differs is noticed."""

import importlib.util
import json
import re
import shlex

import pytest

from benchmarks.command import BenchmarkError
from benchmarks.reproduce.__main__ import MEASUREMENTS, README, RESULTS, main, result_rows, run_job, verdict
from benchmarks.reproduce.claims import CLAIMS, HEADING, JOBS, Claim, Job, read_result, read_tables, unclaimed
from tests.test_docs import command_line  # noqa: F401 (a fixture)

IN_SHORT, IN_FULL = (read_tables(page.read_text(), HEADING) for page in (README, RESULTS))
DOCUMENTS = result_rows()
LENGTH = Claim("217 rings", "1,283.7 m", 0.05, job="metro", read=lambda content: content["length"])


def first(row: dict[str, str]) -> str:
    return next(iter(row.values()))


def test_the_readme_has_a_table_of_results_and_the_page_of_results_the_whole_of_it():
    assert len(IN_SHORT) >= 10
    assert len(IN_FULL) >= 20
    assert len(read_tables(MEASUREMENTS.read_text())) > 100


@pytest.mark.parametrize("row", [*IN_SHORT, *IN_FULL], ids=first)
def test_every_row_of_results_is_measured_or_listed(row):
    claims = [claim for claim in CLAIMS if claim.row in first(row)]
    assert [claim for claim in claims if claim.stated([row]) is not None], "no claim in benchmarks/reproduce/claims.py"
    rest = unclaimed(row)
    assert not re.search(r"(?<![A-Za-z])\d", rest), f"no claim for the numbers in {rest!r}"


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: f"{claim.row}: {claim.text or claim.column}")
def test_every_claim_stands_in_the_documents_and_can_fail(claim):
    stated = claim.stated(DOCUMENTS)
    assert stated is not None
    if claim.job:
        assert claim.job in JOBS
        assert callable(claim.read)
    else:
        assert importlib.util.find_spec(claim.command.split()[0]), claim.command
        assert re.search(r"(core|H[12]00|outside).*, 20\d\d-\d\d-\d\d$", claim.measured)
    worse = {"at least": 0.0, "at most": 1e3 * (stated + 1.0)}.get(claim.bound, stated + 1.1 * claim.tolerance + 1e-3)
    assert verdict(claim, stated, stated) == "same"
    assert verdict(claim, stated, worse) == "differs"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of runpy: the tests have imported the module before
def test_every_command_of_jobs_and_claims_is_understood_by_its_module(command_line):  # noqa: F811
    of_jobs = {words.format(out="out", shared="shared") for job in JOBS.values() for words in job.commands}
    of_claims = {claim.command.split(" (")[0] for claim in CLAIMS if claim.command}
    for words in sorted(of_jobs | of_claims):
        if words.split()[0] not in ("timeit", "pytest"):
            command_line(shlex.split(words))


def test_a_number_is_found_in_its_row_over_thousands_and_columns():
    rows = read_tables("# A\n| what | figure |\n|---|---|\n| metro, 217 rings | **1,283.7 m**; more |\n")
    assert LENGTH.stated(rows) == 1283.7
    assert LENGTH.stated(read_tables("| what | figure |\n|---|---|\n| other | 1,283.7 m |\n")) is None
    assert LENGTH.stated(read_tables("| what | figure |\n|---|---|\n| metro, 217 rings | 1,283.8 m |\n")) is None
    agents = read_tables("| agent | sees | T0 | T1 |\n|---|---|---|---|\n| ring count | LiDAR | 100 | 98 |\n")
    assert Claim("ring count", "", 0.5, column="T1").stated(agents) == 98.0
    assert Claim("ring count", "", 0.5, column="T2").stated(agents) is None
    assert read_tables("# A\n| a | b |\n|---|---|\n| 1 | 2 |\n# B\n| a | b |\n|---|---|\n| 3 | 4 |\n", "B") == [
        {"a": "3", "b": "4"}
    ]


def test_a_number_that_nobody_claims_is_left_over():
    row = {"what": "real metro, 217 rings", "figure": "1,283.7 m; ring centres within 0.3 mm; 17 s"}
    assert re.findall(r"\d+", unclaimed(row)) == ["17"]


@pytest.mark.parametrize(
    ("stated", "measured", "result"),
    [
        (1283.7, 1283.73, "same"),
        (1283.7, 1283.80, "differs"),
        (1283.7, 1283.60, "differs"),
        (None, 1283.7, "not in the documents"),
        (1283.7, None, "not measured: its input is not here"),
    ],
)
def test_a_number_beyond_its_tolerance_differs(stated, measured, result):
    assert verdict(LENGTH, stated, measured) == result


@pytest.mark.parametrize(("bound", "less", "more"), [("at least", "differs", "same"), ("at most", "same", "differs")])
def test_a_bound_is_open_on_one_side(bound, less, more):
    claim = Claim("speed", "2.0 M", 0.5, bound)
    assert [verdict(claim, 2.0, measured) for measured in (1.4, 1.6, 2.4, 2.6)] == [less, "same", "same", more]


def test_what_is_there_is_not_measured_again_and_is_held_against_the_readme(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "150")
    manifest = tmp_path / "metro" / "scene" / "manifest.json"
    manifest.parent.mkdir(parents=True)
    for length, status, result in ((1283.732, 0, "same"), (1290.0, 1, "differs")):
        manifest.write_text(json.dumps({"bore": {"length": length}}))
        assert main(["--jobs", "metro", "--out", str(tmp_path)]) == status
        output = capsys.readouterr().out
        assert result in output
        assert "python -m benchmarks.b2 --robots 8192" in output
    assert json.loads((tmp_path / "reproduce.json").read_text())["rows"][0]["measured"] == 1290.0


def test_seeds_that_learnt_are_counted(tmp_path):
    for seed, success in enumerate((1.0, 0.5, 1.0)):
        (tmp_path / f"seed-{seed}").mkdir()
        line = {"success_mean_100": success, "coverage_mean_100": 0.95}
        (tmp_path / f"seed-{seed}" / "log.jsonl").write_text(json.dumps(line) + "\n")
    assert read_result(tmp_path / "seed-2" / "evaluation.json") == {"learnt": 2}


def test_a_job_that_fails_names_its_log_and_one_without_its_input_is_left_out(tmp_path):
    with pytest.raises(BenchmarkError, match=r"log.txt: python -m json.tool ended with status"):
        run_job(Job("none", ("json.tool {out}/no.json",), "none.json", 0.1), tmp_path / "none", tmp_path)
    assert run_job(JOBS["metro"], tmp_path / "metro", tmp_path / "nowhere") is None


def test_a_job_that_does_not_exist_is_one_sentence_and_status_2(capsys):
    assert main(["--jobs", "everything"]) == 2
    assert capsys.readouterr().err.startswith("error: no job 'everything'; there are speed, ")
