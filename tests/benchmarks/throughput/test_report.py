"""Ratios, tables and the figure say what was measured."""

import io

import matplotlib.pyplot as plt
import pytest
from rich.console import Console

from benchmarks.throughput import report
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.peers import Peer
from benchmarks.throughput.report import Result
from benchmarks.throughput.timing import Speed
from benchmarks.throughput.variants import Variant
from subterra_jax.lidar.reference import Agreement


def speed(n_envs: int, *rates: float) -> Speed:
    return Speed(n_envs, 10, 1.5, list(rates), 0.1, 42.0)


@pytest.fixture
def result() -> Result:
    facts = {"device": "NVIDIA H200", "cpu_cores": 16, "jax": "0.11", "date": "2026-01-01"}
    found = Result(ThroughputConfig(repeats=3), facts, {"name": "t", "length": 351.0, "lining": "pockets"}, 16)
    found.exactness = Agreement(320, 2e-4, 1, 0)
    found.speeds = [speed(16, 90.0, 100.0, 120.0), speed(256, 1800.0, 2000.0, 2100.0)]
    found.floor = [speed(16, 400.0), speed(256, 6000.0)]
    found.arithmetic = 5000.0
    found.peers = [
        Peer("jaxnav", "JaxNav", 16, "0.2", [speed(16, 25.0)], {"256": "out of memory"}),
        Peer("mujoco", "route", 16, "3.17", [speed(1, 20.0)]),
    ]
    found.lengths = [Variant("351 m", 4000, speed(256, 2000.0), (1.0, 1.0, 1.0), Agreement(32, 1e-4, 0, 3))]
    return found


def test_ratios_are_of_medians_at_the_same_size_and_over_the_routes_only_environment(result):
    assert result.ratios(result.peers[0]) == {16: 4.0}
    assert result.ratios(result.peers[1]) == {16: 5.0, 256: 100.0}


def test_every_gate_counts(result):
    assert [gate.n_wrong for gate in result.gates] == [0, 3]


def test_the_tables_hold_speeds_ratios_and_what_was_left_out(result):
    buffer = io.StringIO()
    report.show(result, Console(file=buffer, width=130))
    text = buffer.getvalue()
    for said in ("1.9 k to 2.05 k", "jaxnav, 256: out of memory", "500,000.0", "32 k", "351 m", "0 wrong", "100"):
        assert said in text, said


def test_the_figure_has_a_line_for_everybody_on_logarithmic_axes(result):
    drawn = report.draw(result)
    (axes,) = drawn.axes
    named = {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}
    assert next(iter(named)) == "Subterra, 16 beams"
    assert {"JaxNav, 16 beams", "paper's route, one environment"} < set(named)
    assert sum("floor" in name for name in named) == 1
    assert list(named["Subterra, 16 beams"].get_ydata()) == [100.0, 2000.0]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    plt.close(drawn)


@pytest.mark.parametrize(
    ("value", "said"), [(2.315e8, "231.5 M"), (1.2e9, "1.2 G"), (950.0, "950"), (41_400.0, "41.4 k")]
)
def test_large_rates_are_written_short(value, said):
    assert report.format_rate(value) == said
