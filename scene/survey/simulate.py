"""One survey from beginning to end: draw the bore, walk through it, write what was seen."""

from contextlib import ExitStack

import numpy as np
from rich.console import Console
from rich.progress import Progress

from scene.survey import imu, rack, write
from scene.survey.bore import draw_bore
from scene.survey.carrier import Carried, Walk, draw_walk
from scene.survey.cast import Caster
from scene.survey.config import LidarName, SurveyConfig
from scene.survey.lidar import SCAN_PERIOD
from scene.survey.mesh import Mesh
from scene.survey.profiles import write_profiles
from scene.survey.record import device, inertial, record
from scene.survey.sweeps import n_sweeps, sweeps
from scene.survey.truth import describe

TRUTH_RATE = 200.0  # Hz, rows of groundtruth.tum
_BEHIND = {"avia": 20.0}  # m of bore that a LiDAR sees behind itself, where it is not its whole range


def simulate(config: SurveyConfig, console: Console) -> str:
    """Write the survey of `config`; return a line that says what was written."""
    of_bore, of_walk, of_prism, of_profiles, of_sensors = np.random.SeedSequence(config.seed).spawn(5)
    bore = draw_bore(of_bore, config.length, config.truth, config.correlation)
    mesh = bore.mesh()
    walk = draw_walk(np.random.default_rng(of_walk), bore, config.speed, SCAN_PERIOD)
    config.out.mkdir(parents=True, exist_ok=True)

    write.write_mesh(config.out / "truth.ply", mesh)
    write.write_json(config.out / "truth.json", describe(bore, config))
    prism = imu.measure_prism(np.random.default_rng(of_prism), walk, config.errors.prism_noise)
    write.write_tum(config.out / "prism.tum", *prism, None)
    told = [f"{config.out}: {config.length:g} m"]
    if config.profiles:
        told.append(f"{write_profiles(config, bore, Caster(mesh), of_profiles)} points in profiles")
    # A sensor's noise does not depend on which others are on the rack.
    seeds = dict(zip(rack.LIDARS, of_sensors.spawn(len(rack.LIDARS)), strict=True))
    for name in config.sensors:
        told.append(_survey(config, name, walk, mesh, seeds[name], console))
    return ", ".join(told)


def _survey(
    config: SurveyConfig, name: LidarName, walk: Walk, mesh: Mesh, seed: np.random.SeedSequence, console: Console
) -> str:
    """Write recording, ground truth and calibration of one device."""
    of_lidar, *of_imus = seed.spawn(1 + len(rack.IMUS[name]))
    one, carried = device(name, config), Carried(walk, rack.LIDARS[name])
    time = np.arange(round(walk.duration * TRUTH_RATE) + 1) / TRUTH_RATE
    poses = carried.poses(time)
    write.write_tum(config.out / f"groundtruth{one.suffix}.tum", time, poses.position, poses.quaternion)
    write.write_yaml(config.out / f"calibration{one.suffix}.yaml", rack.calibration(name))

    every = 1 if name == "avia" else config.scan_every
    caster = Caster(mesh, _BEHIND.get(name, one.lidar.range_max))
    seen = sweeps(np.random.default_rng(of_lidar), one.lidar, carried, caster, config.errors, every)
    count = n_sweeps(carried, every)
    with ExitStack() as stack:
        cloud = None
        if config.cloud and name == config.sensors[0]:
            paths = (stack.enter_context(write.replacing(config.out / f"cloud.{kind}")) for kind in ("ply", "pcd"))
            cloud = stack.enter_context(write.CloudWriter(*paths))
        progress = stack.enter_context(Progress(console=console, transient=True))
        tracked = progress.track(seen, total=count, description=f"survey, {name}")
        bag = config.out / f"survey{one.suffix}.bag"
        returns = record(bag, one, tracked, inertial(of_imus, name, carried, config), cloud)
    return f"{name}: {count} scans, {returns} returns"
