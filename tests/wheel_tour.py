"""Makes, resets and steps every task with every sensor, and prints CPU-seconds and megabytes; needs the wheel alone.

python -P wheel_tour.py [ID ...] [SENSOR ...]: all ids, all sensors where none is named. A second time is that
with the tunnels on disk.
"""

import resource
import sys
import time

import jax
import numpy as np

import subterra_jax as st
from subterra_jax.parts.spatial_lidar import SENSORS


def tour(id: str, sensor: str) -> str:
    """Return a line of the table: CPU-seconds of make, of reset and of a step, megabytes of tunnel and of process."""
    marks = [time.process_time()]
    env, params = st.make(id, **({} if sensor == SENSORS[0] else {"sensor": sensor}))
    marks.append(time.process_time())
    obs, state = env.reset(jax.random.key(0), params)
    marks.append(time.process_time())
    action = jax.numpy.zeros(getattr(env, "action_size", 12))
    obs, *_ = env.step(jax.random.key(1), state, action, params)
    marks.append(time.process_time())
    if not np.isfinite(obs).all():
        raise SystemExit(f"{id}, {sensor}: an observation is not finite")
    tunnel = sum(leaf.nbytes for leaf in jax.tree.leaves(params.tunnel)) / 1e6
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    seconds = " ".join(f"{seconds:6.1f}" for seconds in np.diff(marks))
    return f"{id:28} {sensor:10} {seconds} s {tunnel:7.1f} MB {most:7.0f} MB {obs.shape}"


def main(words: list[str]) -> None:
    """Print the table."""
    ids = [word for word in words if word in st.list_tasks()] or list(st.list_tasks())
    sensors = [word for word in words if word in SENSORS] or list(SENSORS)
    print(f"{'id':28} {'sensor':10} {'make':>6} {'reset':>6} {'step':>6}   {'tunnel':>7}    {'most':>7}")
    for id in ids:
        for sensor in sensors:
            if "B2Walk" in id and sensor != SENSORS[0]:
                continue  # it has no LiDAR
            print(tour(id, sensor), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
