"""The throughput command, at sizes that say nothing about speed."""

import sys

import pytest

import subterra_jax as st
from benchmarks import reference
from benchmarks.records import read_records
from benchmarks.results import environment_facts
from benchmarks.throughput import __main__ as command
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.report import Result


def run_here(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["throughput", *arguments])
    return command.main()


def test_one_run_writes_speeds_and_the_gate(tmp_path, monkeypatch, capsys):
    size = ("--n", "8", "--steps", "4", "--repeats", "3", "--poses", "500", "--peers", "none")
    arguments = ("--task", "Subterra/TraverseShort-v1", *size, "--out", str(tmp_path / "speed"))
    assert run_here(monkeypatch, *arguments) == 0
    error, speed = read_records(tmp_path / "speed" / "records.json")
    assert (error.id, error.n, error.bound) == ("speed/lidar-error", 8000, "at most")
    assert error.value < 1.0
    assert (speed.id, speed.bound) == ("speed/cpu-8", "at least")
    assert "8,000 rays: largest error" in capsys.readouterr().out


def test_several_tunnels_are_measured_together_and_compared_one_by_one(tmp_path, monkeypatch, capsys):
    quick = ("--n", "4", "--steps", "1", "--repeats", "1", "--poses", "20")
    several = ("--task", "Subterra/StopAtShort-v1", "--tunnel", "open:cast:train:0-1", "--copies", "2")
    assert run_here(monkeypatch, *quick, *several, "--out", str(tmp_path)) == 0
    assert [record.id for record in read_records(tmp_path / "records.json")] == ["speed/4-tunnels-4"]
    told = capsys.readouterr().out
    assert "320 rays" in told
    assert " 0 wrong" in told
    assert ":train:" in told, "a part of the name was taken for a picture"
    true_scan = reference.lidar.scan
    monkeypatch.setattr(reference.lidar, "scan", lambda *args, **rest: true_scan(*args, **rest) + 0.01)
    assert run_here(monkeypatch, *quick, *several) == 1


def test_a_peer_that_was_asked_for_and_is_not_there_is_a_mistake(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "jaxmarl", None)
    monkeypatch.setitem(sys.modules, "jaxmarl.environments.jaxnav.jaxnav_env", None)
    assert run_here(monkeypatch, "--peers", "jaxnav") == 2
    assert "peer 'jaxnav' cannot be imported" in capsys.readouterr().err


def test_a_lidar_that_is_a_centimetre_off_fails_the_run(monkeypatch, capsys):
    plan, true_scan = st.load_tunnel().slice(0.0, 50.0), reference.lidar.scan
    params = st.make("Subterra/Traverse-v1", plan)[1]
    monkeypatch.setattr(reference.lidar, "scan", lambda *args, **rest: true_scan(*args, **rest) + 0.01)
    gate = reference.measure_exactness([plan], "pockets", params, 20, seed=0)
    # Beams that leave through a mouth report the largest range, a centimetre more now.
    assert gate.n_wrong == gate.n_rays == 320
    facts = {"name": "t", "length": 50.0, "lining": "pockets"}
    found = Result(ThroughputConfig(), environment_facts(), facts, 16, exactness=gate)
    monkeypatch.setattr(command, "run", lambda config: found)
    assert run_here(monkeypatch) == 1
    output = capsys.readouterr()
    assert "320 wrong" in output.out
    assert "disagrees with the reference" in output.err
