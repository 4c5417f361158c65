"""Draws how policies from wheels drive a robot by physics, from the records of `benchmarks.b2_traverse`.

`python -m benchmarks.draw transfer --out docs/transfer.png`
"""

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.records import FOLDER, Record, read_records
from benchmarks.results import png_bytes, write_file

_ROBOTS = {"wheels": "wheels", "rover/mjx": "rover, MJX", "rover/mujoco": "rover, MuJoCo"}
_COLOURS = ("#1b4965", "#c1121f", "#e09f3e")
_LEFT_OUT = {"speed-obeyed": "speed obeyed, %", "yaw-obeyed": "yaw rate obeyed, %", "odometer-error": "odometer, %"}
_WIDTH = 0.26  # of a bar


@dataclass(frozen=True)
class TransferConfig:
    """Settings of the picture."""

    out: Path = Path("out/transfer.png")  # File to write.
    records: Path = FOLDER / "b2.json"  # Records to draw.


def run(config: TransferConfig) -> None:
    """Draws success beside what the kinematic robot leaves out, for each task and policy."""
    found = {record.id: record for record in read_records(config.records)}
    parts = [name.split("/") for name in found if name.startswith("b2/wheels/") and name.endswith("/success")]
    drives = [(task, agent) for _, _, task, agent, _ in parts if f"b2/rover/{task}/mjx/{agent}/success" in found]
    figure, axes = plt.subplots(1, 1 + len(_LEFT_OUT), figsize=(13.0, 3.6), layout="constrained", sharey=True)
    for panel, figure_name in zip(axes, ("success", *_LEFT_OUT), strict=True):
        panel.set_title(_LEFT_OUT.get(figure_name, "success, %"), fontsize=10)
        for k, robot in enumerate(_ROBOTS):
            kind, _, engine = robot.partition("/")
            shown = []
            for j, (task, agent) in enumerate(drives):
                name = "/".join(["b2", kind, task, *([engine] if engine else []), agent, figure_name])
                if (one := found.get(name)) is not None:
                    shown.append((j + (k - 1) * _WIDTH, one.value, *_reach(one, found.get(f"{name}-sigma"))))
            place, value, *reach = np.array(shown).reshape(-1, 4).T
            panel.barh(place, value, _WIDTH, color=_COLOURS[k], label=_ROBOTS[robot], xerr=reach)
        panel.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(range(len(drives)), [f"{task}\n{agent}" for task, agent in drives], fontsize=8)
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=len(_ROBOTS))
    write_file(config.out, png_bytes(figure, dpi=80))


def _reach(record: Record, sigma: Record | None) -> tuple[float, float]:
    """Ends of an error bar: its interval, or the spread between robots."""
    if record.interval is not None:
        return record.value - record.interval[0], record.interval[1] - record.value
    return (sigma.value, sigma.value) if sigma is not None else (0.0, 0.0)
