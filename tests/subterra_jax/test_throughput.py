"""The throughput command, at a size that says nothing about speed."""

import json
import subprocess
import sys

import pytest


def run(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-m", "benchmarks.throughput", *arguments], capture_output=True, text=True)


def test_the_benchmark_writes_speeds_and_an_exactness_gate(tmp_path):
    out = tmp_path / "speed.json"
    size = ("--n", "8", "16", "--steps", "4", "--repeats", "3", "--poses", "500")
    done = run("--task", "Subterra/TraverseShort-v0", *size, "--out", str(out))
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    assert [speed["n_envs"] for speed in result["speed"]] == [8, 16]
    for speed in result["speed"]:
        assert 0 < speed["q1"] <= speed["median"] <= speed["q3"]
        assert len(speed["steps_per_second"]) == 3
    assert result["exactness"]["n_rays"] == 8000
    assert result["exactness"]["n_wrong"] == 0
    assert result["exactness"]["max_error"] < 1e-3
    assert result["environment"]["jax"]


@pytest.mark.parametrize("arguments", [("--task", "Subterra/Nowhere-v0"), ("--lining", "velvet")])
def test_a_mistake_is_one_sentence_and_status_2(arguments):
    done = run(*arguments)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("error: ")
