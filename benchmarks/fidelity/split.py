"""Cuts a recording into what is fitted, what thresholds are chosen on and what is held out, by blocks of time."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2

from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.filehash import file_hash
from benchmarks.fidelity.store import write_json
from scene.cli import progress_bar
from scene.files import replace_folder, require_input

PARTS = ("fit", "val", "hold")
GUARD = -1
SCHEMA = "subterra.split/1"


@dataclass(frozen=True)
class SplitConfig:
    """The rule.

    Attributes:
        block: Length of a block, s.
        guard: Left out around every border between parts, s.
        shares: Of fit, val and hold.
        seed: Of the order of the blocks.
    """

    block: float = 2.0
    guard: float = 0.2
    shares: tuple[float, float, float] = (0.6, 0.2, 0.2)
    seed: int = 0


def deal(duration: float, config: SplitConfig) -> Int[np.ndarray, " b"]:
    """The part of each block of a recording of some seconds.

    Blocks are dealt in hands of five, each of which holds the parts in their shares, so that every part sees the whole
    tunnel; the order within a hand is drawn.
    """
    hand = np.repeat(np.arange(3), np.round(5 * np.asarray(config.shares)).astype(int))
    rng = np.random.default_rng(config.seed)
    return np.concatenate([rng.permutation(hand) for _ in range(int(duration / config.block) // len(hand) + 2)])


def part_of(time: float, dealt: Int[np.ndarray, " b"], config: SplitConfig) -> int:
    """0 fit, 1 val, 2 hold for a time since the start of the recording, s; -1 within the guard of a border."""
    block = int(time // config.block)
    into = time - block * config.block
    if block and into < 0.5 * config.guard and dealt[block - 1] != dealt[block]:
        return GUARD
    if config.block - into <= 0.5 * config.guard and dealt[block + 1] != dealt[block]:
        return GUARD
    return int(dealt[block])


def split(recording: Path, out: Path, config: SplitConfig) -> dict[str, Any]:
    """Writes `fit.bag`, `val.bag` and `hold.bag` with the messages as they were recorded, and `split.json`.

    Args:
        recording: A ROS1 bag, a ROS2 bag or an MCAP file.
        out: Folder to write, whole or not at all.
        config: The rule.

    Raises:
        FidelityError: It is no bag, or too short to give every part a block.
    """
    require_input(recording)
    with _opened(recording) as reader, replace_folder(out) as folder:
        counts = _copy(reader, folder, config, recording)
        facts = {
            "schema": SCHEMA, "rule": asdict(config), "messages": counts,
            "recording": _record(recording),
            "parts": {name: _record(folder / _name(name, recording)) for name in PARTS},
        }  # fmt: skip
        write_json(folder / "split.json", facts)
    return facts


@contextmanager
def _opened(recording: Path) -> Iterator[Any]:
    try:
        reader = Reader1(recording) if recording.suffix == ".bag" else AnyReader([recording])
        reader.open()
    except Exception as error:
        raise FidelityError(f"{recording}: is no bag that can be split ({error})") from error
    try:
        yield reader
    finally:
        reader.close()


def _copy(reader: Any, folder: Path, config: SplitConfig, recording: Path) -> dict[str, int]:
    duration = (reader.end_time - reader.start_time) * 1e-9
    if duration < 5 * config.block:
        raise FidelityError(f"{recording}: is shorter than five blocks of {config.block:g} s")
    dealt, counts = deal(duration, config), dict.fromkeys((*PARTS, "guard"), 0)
    with ExitStack() as stack, progress_bar() as progress:
        writers = [stack.enter_context(_writer(folder / _name(name, recording))) for name in PARTS]
        channels = [{c.id: _channel(writer, c) for c in reader.connections} for writer in writers]
        stage = progress.start("split", reader.message_count)
        for connection, stamp, raw in reader.messages():
            part = part_of((stamp - reader.start_time) * 1e-9, dealt, config)
            counts["guard" if part == GUARD else PARTS[part]] += 1
            if part != GUARD:
                writers[part].write(channels[part][connection.id], stamp, raw)
            stage.advance()
    return counts


def _record(path: Path) -> dict[str, str]:
    return {"file": path.name, "sha256": file_hash(path)}


def _writer(path: Path) -> Any:
    return Writer1(path) if path.suffix == ".bag" else Writer2(path, version=9)


def _channel(writer: Any, connection: Any) -> Any:
    """The recording's channel anew, with its own message definition."""
    name, kind, definition = connection.topic, connection.msgtype, connection.msgdef.data
    if isinstance(writer, Writer1):
        return writer.add_connection(name, kind, msgdef=definition, md5sum=connection.digest)
    return writer.add_connection(name, kind, msgdef=definition, rihs01=connection.digest)


def _name(part: str, recording: Path) -> str:
    return f"{part}.bag" if recording.suffix == ".bag" else part
