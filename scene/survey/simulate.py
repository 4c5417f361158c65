"""One survey from beginning to end: draw the bore, walk through it, write a bag for each device."""

import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from scene.survey import messages
from scene.survey.bore import draw_bore
from scene.survey.carrier import (
    GRAVITY,
    IMUS,
    LIDARS,
    Carried,
    Walk,
    calibration,
    draw_walk,
    measure_inertial,
    measure_prism,
)
from scene.survey.cast import Caster, Face, n_sweeps, sweeps
from scene.survey.config import LidarName, SurveyConfig
from scene.survey.lidar import SCAN_PERIOD, Lidar, Sweep, avia, os1, vlp16
from scene.survey.mesh import Mesh
from scene.survey.messages import Convention, Recorder, chunks_of, encode
from scene.survey.write import describe_truth, write_json, write_mesh, write_tum, write_yaml

Message = tuple[int, str, bytes]  # time in ns since the start of the survey, topic, bytes


@dataclass(frozen=True)
class Device:
    """One LiDAR of the rack and how its driver publishes it."""

    lidar: Lidar  # The model
    suffix: str  # Ending of the names of its files
    topic: str  # Topic of its sweeps
    kind: str  # Type of its messages
    encode: Callable[[Sweep, Lidar], bytes]  # A sweep as one of them


def make_device(name: LidarName, config: SurveyConfig) -> Device:
    """Return the device called `name`, with the convention's messages."""
    own, convention = _own_device(name, config), config.convention
    if convention.point_times == "driver":
        return own
    return replace(own, kind=messages.CLOUD_TYPE, encode=partial(encode, convention=convention))


def _own_device(name: LidarName, config: SurveyConfig) -> Device:
    if name == "avia":
        return Device(avia(config.point_rate), "", "/livox/lidar", messages.CUSTOM_TYPE, messages.custom_message)
    if name == "vlp16":
        return Device(vlp16(), "_vlp16", "/velodyne_points", messages.CLOUD_TYPE, messages.velodyne_message)
    return Device(os1(), "_os1", "/ouster/points", messages.CLOUD_TYPE, messages.ouster_message)


def draw_imu_messages(
    seeds: list[np.random.SeedSequence], name: LidarName, carried: Carried, config: SurveyConfig
) -> list[Message]:
    """Draws the messages of all IMUs of a device, in order of time, with a seed for each."""
    out = []
    for seed, one in zip(seeds, IMUS[name], strict=True):
        sample = measure_inertial(np.random.default_rng(seed), carried, one.rate, one.mount, config.errors)
        at = np.rint(sample.time * 1e9).astype(np.int64)
        accel = sample.accel / (GRAVITY if one.in_g else 1.0)
        stamp = at + round(1e9 * config.convention.imu_late)
        raw = messages.imu_messages(
            one.frame, stamp, sample.quaternion if one.orientation else None, sample.gyro, accel
        )
        out += [(int(t), one.topic, m) for t, m in zip(at, raw, strict=True)]
    return sorted(out, key=lambda m: m[:2])


def write_recording(
    path: Path,
    device: Device,
    sweeps: Iterable[Sweep],
    inertial: list[Message],
    convention: Convention = Convention(),  # noqa: B008 (frozen)
    count: int = 0,
) -> tuple[Path, int]:
    """Writes the recording of `count` sweeps; returns its path and the number of returns.

    A message is recorded when it is complete: a sweep one period after its first point. Sweeps and IMU messages come in
    the order of time.
    """
    returns, waiting = 0, iter([*inertial, (2**62, "", b"")])
    kinds = {topic: messages.IMU_TYPE for _, topic, _ in inertial} | {device.topic: device.kind}
    starts = {k * count // convention.bags for k in range(1, convention.bags)}
    with Recorder(path, kinds, convention) as bag:
        at, topic, raw = next(waiting)
        for number, sweep in enumerate(sweeps):
            if number in starts:
                bag.start_part()
            end = sweep.begin + round(SCAN_PERIOD * 1e9)
            while at < end:
                bag.write(topic, at, raw)
                at, topic, raw = next(waiting)
            for chunk, lidar in chunks_of(sweep, device.lidar, convention):
                bag.write(device.topic, end, device.encode(chunk, lidar))
            returns += int(sweep.valid.sum())
        while topic:
            bag.write(topic, at, raw)
            at, topic, raw = next(waiting)
    return bag.path, returns


TRUTH_RATE = 200.0  # Hz, rows of groundtruth.tum
_WORTH_A_PROCESS = 100.0  # m from which on every further device is simulated in a process of its own
_BEHIND = {"avia": 20.0}  # m of bore that a LiDAR sees behind itself, where it is not its whole range


def simulate(config: SurveyConfig, console: Console) -> str:
    """Writes the survey of `config`; returns a line that says what was written."""
    of_bore, of_walk, of_prism, _, of_sensors = np.random.SeedSequence(config.seed).spawn(5)
    bore = draw_bore(of_bore, config.length, config.truth, config.correlation, config.tolerances)
    mesh = bore.mesh()
    walk = draw_walk(np.random.default_rng(of_walk), bore, config.speed, SCAN_PERIOD)
    config.out.mkdir(parents=True, exist_ok=True)

    write_mesh(config.out / "truth.ply", mesh)
    write_json(config.out / "truth.json", describe_truth(bore, config))
    prism = measure_prism(np.random.default_rng(of_prism), walk, config.errors.prism_noise)
    write_tum(config.out / "prism.tum", *prism, None)
    parts = [f"{config.out}: {config.length:g} m"]
    # A sensor's noise does not depend on which others are on the rack.
    seeds = dict(zip(LIDARS, of_sensors.spawn(len(LIDARS)), strict=True))
    face = Face(bore.alignment, bore.section, config.texture, config.seed) if config.texture else None
    jobs = [(config, name, walk, mesh, face, seeds[name]) for name in config.sensors]
    apart = jobs[1:] if config.length >= _WORTH_A_PROCESS else []
    with ExitStack() as stack:
        waiting = []
        if apart:
            pool = stack.enter_context(ProcessPoolExecutor(len(apart), multiprocessing.get_context("spawn")))
            stack.callback(pool.shutdown, cancel_futures=True)
            waiting = [pool.submit(_simulate_device, *job) for job in apart]
        parts += [_simulate_device(*job, console) for job in jobs[: len(jobs) - len(apart)]]
        parts += [one.result() for one in waiting]
    return ", ".join(parts)


def _simulate_device(
    config: SurveyConfig,
    name: LidarName,
    walk: Walk,
    mesh: Mesh,
    face: Face | None,
    seed: np.random.SeedSequence,
    console: Console | None = None,
) -> str:
    of_lidar, *of_imus = seed.spawn(1 + len(IMUS[name]))
    one, carried = make_device(name, config), Carried(walk, LIDARS[name])
    time = np.arange(round(walk.duration * TRUTH_RATE) + 1) / TRUTH_RATE
    poses = carried.poses(time)
    write_tum(config.out / f"groundtruth{one.suffix}.tum", time, poses.position, poses.quaternion)
    write_yaml(config.out / f"calibration{one.suffix}.yaml", calibration(name))

    every = 1 if name == "avia" else config.scan_every
    caster = Caster(mesh, _BEHIND.get(name, one.lidar.range_max))
    seen = sweeps(np.random.default_rng(of_lidar), one.lidar, carried, caster, config.errors, every, face=face)
    count = n_sweeps(carried, every)
    with Progress(console=console or Console(quiet=True), transient=True) as progress:
        tracked = progress.track(seen, total=count, description=f"survey, {name}")
        bag = config.out / f"survey{one.suffix}.bag"
        inertial = draw_imu_messages(of_imus, name, carried, config)
        _, returns = write_recording(bag, one, tracked, inertial, config.convention, count)
    return f"{name}: {count} scans, {returns} returns"
