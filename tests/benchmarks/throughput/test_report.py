"""Ratios and tables say what was measured."""

import pytest

from benchmarks.reference import Agreement
from benchmarks.results import environment_facts
from benchmarks.throughput import report
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.loops import Peer
from benchmarks.throughput.report import Result
from benchmarks.throughput.timing import Speed


def speed(n_envs: int, *rates: float) -> Speed:
    return Speed(n_envs, 10, 1.5, list(rates), 0.1, 42.0)


@pytest.fixture
def result() -> Result:
    facts = {"device": "NVIDIA H200", "cpu_cores": 16, "jax": "0.11", "date": "2026-01-01"}
    found = Result(ThroughputConfig(repeats=3), facts, {"name": "t", "length": 351.0, "lining": "pockets"}, 16)
    found.exactness = Agreement(320, 2e-4, 1, 0)
    found.speeds = [speed(16, 90.0, 100.0, 120.0), speed(256, 1800.0, 2000.0, 2100.0)]
    found.peers = [Peer("jaxnav", "JaxNav", "0.2", [speed(16, 25.0)], {"256": "out of memory"})]
    return found


def test_ratios_are_of_medians_at_the_same_size(result):
    assert result.ratios(result.peers[0]) == {16: 4.0}


def test_the_tables_hold_speeds_ratios_and_what_was_left_out(result):
    text = report.as_text(result)
    for said in ("1.9 k to 2.05 k", "jaxnav, 256: out of memory", "500,000.0", "32 k", "4 at 16", "0 wrong"):
        assert said in text, said


def test_a_record_names_sensor_and_texture_and_how_to_measure_again(result):
    result.config = ThroughputConfig(n=(16,), sensor="vlp16", texture=0.5, poses=0)
    result.environment = environment_facts()
    result.tunnel["tunnels"], result.exactness = 1, None
    found = report.records_of(result)
    assert [record.id for record in found] == ["speed/cpu-vlp16-texture-16", "speed/cpu-vlp16-texture-256"]
    assert "--sensor vlp16 --texture 0.5 --n 16 --poses 0" in found[0].command
