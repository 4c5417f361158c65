"""Throughput: what is timed and how, and its command at sizes that say nothing about speed."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from benchmarks.records import read_records
from benchmarks.reference import Agreement
from benchmarks.results import environment_facts
from benchmarks.throughput import __main__ as command
from benchmarks.throughput import report, timing
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.loops import Peer, environment_loop, measure_jaxnav
from benchmarks.throughput.report import Result
from benchmarks.throughput.timing import Loop, Speed, Timing, digest, measure
from tests.recorded import check, lines_of

VALUES = Path(__file__).parents[1] / "values.csv"


def counting(first: float = 0.0) -> Loop:
    """The observation counts steps; nothing else is returned."""
    return Loop(
        reset=lambda key, params: (jnp.full((3,), first), jnp.zeros(3)),
        step=lambda key, carry, params: ((carry[0] + 1.0, carry[1]), jnp.zeros(()), jnp.float32(0.25)),
    )


def test_every_observation_is_in_the_checksum():
    speed = measure(counting(), 3, Timing(steps=4, repeats=2))
    # The call that warms up counts from 0 to 4, so the timed ones see 4..8 and 8..12.
    assert speed.checksum == sum(range(4, 9)) + sum(range(8, 13))
    assert speed.share_done == 0.25
    assert len(speed.steps_per_second) == 2


def test_a_rate_counts_the_steps_of_every_environment(monkeypatch):
    clock = iter(range(0, 100, 2))
    monkeypatch.setattr(timing, "perf_counter", lambda: next(clock))  # each call takes 2 s
    assert measure(counting(), 3, Timing(steps=4, repeats=2)).steps_per_second == [3 * 4 / 2.0] * 2


def test_calls_get_fewer_steps_where_they_would_take_too_long():
    assert measure(counting(), 3, Timing(steps=50, repeats=2, seconds=1e-9)).steps == 1
    assert measure(counting(), 3, Timing(steps=50, repeats=2, seconds=1e9)).steps == 50


def test_what_is_not_finite_stops_the_run():
    with pytest.raises(FloatingPointError, match="n_envs=3"):
        measure(counting(np.inf), 3, Timing(steps=2, repeats=1))


def test_one_number_of_any_observation_changes_the_digest():
    obs = np.random.default_rng(0).uniform(0.0, 30.0, (4, 18)).astype(np.float32)
    bumped = np.tile(obs, (72, 1, 1))
    bumped[np.arange(72), np.arange(72) // 18, np.arange(72) % 18] += 0.05
    assert not np.any(np.asarray(jax.vmap(digest)(bumped)) == np.asarray(digest(obs)))


def test_the_same_seed_measures_the_same_steps():
    loop = environment_loop(*st.make("Subterra/TraverseShort-v1"), 4)
    first, again, other = (measure(loop, 4, Timing(3, 1, seed=seed)).checksum for seed in (0, 0, 1))
    assert first == again
    assert first != other


def test_sizes_are_measured_once_each_and_stop_at_4096_on_a_cpu(monkeypatch):
    assert ThroughputConfig(n=(16, 1, 16)).sizes() == (1, 16)
    assert ThroughputConfig().sizes() == (1, 16, 256, 1024, 4096)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert ThroughputConfig().sizes()[-1] == 262_144


def test_a_peer_that_breaks_is_left_out_with_its_reason():
    def broken(n_envs: int) -> Loop:
        raise RuntimeError("RESOURCE_EXHAUSTED: 1 TiB" if n_envs > 4 else "no such map")

    peer = measure_jaxnav((4, 8), Timing(), lambda _: None, broken)
    assert peer.left_out == {"4": "RuntimeError: no such map", "8": "out of memory"}
    assert peer.speeds == []


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


def test_the_page_and_the_records_of_a_run_are_those_of_the_table(result):
    pages = {"one": report.as_text(result)}
    result.tunnel["tunnels"], result.environment["platform"] = 1, "gpu"
    found = report.records_of(result)
    result.config = ThroughputConfig(
        n=(16,), sensor="vlp16", texture=0.5, poses=0, tunnel="open:cast:val:0-1", copies=2
    )
    result.speeds += [speed(65_536, 1e9, 2.4e9, 3e9)]
    pages["several"] = report.as_text(result)
    found += report.records_of(result)
    result.environment["platform"], result.tunnel["tunnels"] = "cpu", 4
    found += report.records_of(result)
    check(VALUES, "throughput", {"pages": pages, "records": lines_of(found)})


def run_here(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["throughput", *arguments])
    return command.main()


@pytest.mark.parametrize(("words", "name"), [
    ("--n 8 4 --steps 3 --repeats 2 --seconds 7 --seed 5 --poses 70 --lining smooth", "one"),
    ("--n 8 --tunnel control,subterra-351 --copies 3", "several"),
    ("--n 8 --poses 0 --peers none --tunnel control --sensor vlp16 --texture 0.5", "alone"),
])  # fmt: skip
def test_a_run_measures_what_is_asked_for(words, name, tmp_path, monkeypatch, capsys):
    seen = {}

    def note(name, answer):
        def called(*args):
            seen.setdefault(name, []).append(args)
            return answer(*args)

        return called

    monkeypatch.setattr(command, "environment_loop", note("loop", lambda env, params, n: params))
    monkeypatch.setattr(command, "measure", note("speed", lambda loop, n, timing: speed(n, 1e6 * n)))
    monkeypatch.setattr(command, "measure_jaxnav", note("peer", lambda *_: Peer("jaxnav")))
    monkeypatch.setattr(command, "measure_exactness", note("gate", lambda *given: Agreement(16 * given[3], 2e-4, 1, 0)))
    assert run_here(monkeypatch, *words.split(), "--out", str(tmp_path)) == 0
    told = {
        "printed": capsys.readouterr().out.partition("; ")[2], "timing": [str(one[2]) for one in seen["speed"]],
        "peers": str([one[0] for one in seen.get("peer", [])]), "facts": str([one[1] for one in seen["speed"]]),
        "gate": str([(len(plans), *rest) for plans, lining, _, *rest in seen.get("gate", [])]),
        "made": str([(params.tunnel.count, params.lidar.n_beams, n) for _, params, n in seen["loop"]]),
    }  # fmt: skip
    check(VALUES, f"throughput of {name}", told | {"records": lines_of(read_records(tmp_path / "records.json"))})


def test_a_peer_that_is_not_installed_is_left_out_with_its_reason_and_a_mistake_to_ask_for(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "jaxmarl", None)
    monkeypatch.setitem(sys.modules, "jaxmarl.environments.jaxnav.jaxnav_env", None)
    peer = measure_jaxnav((1, 2), Timing(), lambda _: None)
    assert (peer.speeds, "jaxmarl" in peer.left_out["all"]) == ([], True)
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
