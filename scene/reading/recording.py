"""Any recording as a stream of timed scans."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.errors import RecordingError
from scene.reading.formats import detect
from scene.reading.scans import ScanSource
from scene.reading.source import refuse_damage
from scene.reading.times import MOST_BAD, SHORT, WHOLE, Convention, RawScan, Scan, Spans, TimeConfig, join_scans

_MOST_OUT_OF_ORDER = 0.05  # fraction of the scans
_LONGEST_PAUSE = 3600.0  # s; a stamp further from the last one is damage, and would make all later ones look late


class Recording:
    """An open recording. A context manager; iterate `scans()` as often as needed.

    Attributes:
        path: The recording.
        topic: The LiDAR topic read; the folder's name for a folder of scans.
        facts: Detected facts, for the manifest; `point_times` and the counts of what is left out follow on reading.

    Raises:
        RecordingError: Not a recording, truncated, or without a LiDAR topic.
    """

    def __init__(
        self,
        path: Path,
        topic: str | None = None,
        format: str | None = None,
        times: TimeConfig | None = None,
        more: tuple[Path, ...] = (),
    ) -> None:
        self.path, self._told = path, times or TimeConfig()
        self._points = self._bad = 0
        detected = detect(path, format)
        if detected.format.kind != "recording":
            raise RecordingError(f"{path}: is no recording of scans, but {detected.format.name}")
        parts = [detect(part, format) for part in more]
        if odd := next((part for part in parts if part.format != detected.format), None):
            raise RecordingError(f"{odd.path}: is no {detected.format.label} as {path} is, so no part of one recording")
        with refuse_damage(path, f"a readable {detected.format.label}", RecordingError):
            beside = (tuple(part.path for part in parts),) if parts else ()
            self._source: ScanSource = detected.format.open(detected.path, topic, *beside)
        self._source.facts["format_by"] = detected.by
        self.topic, self.facts = self._source.topic, self._source.facts

    @property
    def reader(self) -> Any:
        """The bag's reader, for the IMU beside the LiDAR: `connections` and `messages(connections=…)`."""
        return self._source.reader

    def deserialize(self, raw: bytes, message_type: str) -> Any:
        """Return a message of a standard type from `reader` as an object; the library raises anything on damage."""
        return self._source.deserialize(raw, message_type)

    def __enter__(self) -> "Recording":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.close()

    @cached_property
    def _spans(self) -> Spans:
        """Headers and times of all sweeps, read once from end to end."""
        spans = Spans()
        for raw in self._source.scans():
            spans.add(raw)
        return spans

    @cached_property
    def _groups(self) -> list[list[int]]:
        """Numbers of the messages of each sweep: one, or as many as make a whole one where they are short."""
        stamps, step = self.stamps, self.convention.step
        if step >= SHORT or self.convention.kind == "static":
            return [[number] for number in range(len(stamps))]
        groups: list[list[int]] = []
        for number, stamp in enumerate(stamps):
            if not groups or not -step < stamp - stamps[groups[-1][0]] < WHOLE - 0.5 * step:
                groups.append([])
            groups[-1].append(number)
        return groups

    @property
    def scan_count(self) -> int:
        """Number of sweeps."""
        return len(self._groups)

    @property
    def stamps(self) -> Float[np.ndarray, " n"]:
        """Header of each sweep, s; the time of recording where headers say nothing."""
        return np.array([row[1 if self.convention.by_receipt else 0] for row in self._spans.rows])

    @cached_property
    def convention(self) -> Convention:
        """Meaning of the times of points, decided from all sweeps; raises `RecordingError` where they fit nothing."""
        spans = self._spans
        try:
            found = spans.decide(self._told)
        except ValueError as error:
            first = spans.timed[0] if spans.timed else 0
            raise RecordingError(f"{self.path}: scan {first} of {self.topic} {error}") from error
        self.facts["point_times"] = found.words
        return found

    def take_end(self) -> None:
        """Take each header for the end of its sweep from now on, as another clock has shown."""
        found = self._spans.decide(replace(self._told, time_stamp="end"), "as the turns of another clock show")
        self.__dict__["convention"] = found
        self.facts["point_times"] = found.words

    def scans(self) -> Iterator[Scan]:
        """Yields the scans in the order of the recording.

        A scan whose time does not grow is left out and counted in `facts`, and so is a point whose time is none of its
        sweep. Raises `RecordingError`, which says which message is damaged, or where more than 5 % of either are left
        out.
        """
        convention, last, late = self.convention, None, 0
        self._points = self._bad = 0
        messages = self._source.scans()
        for index, group in enumerate(self._groups):
            scan = join_scans([self._timed(convention, next(messages)) for _ in group])
            if last is not None and scan.stamp <= last:
                late += 1
                self.facts["scans_out_of_order"] = late
                if late > max(_MOST_OUT_OF_ORDER * self.scan_count, 1):
                    raise RecordingError(
                        f"{self.path}: the times of {self.topic} do not grow: scan {index} is of {scan.stamp:.3f} s, "
                        f"one before it of {last:.3f} s"
                    )
                continue
            if last is not None and scan.stamp > last + _LONGEST_PAUSE:
                raise RecordingError(
                    f"{self.path}: scan {index} of {self.topic} is of {scan.stamp:.3f} s, "
                    f"{scan.stamp - last:.0f} s after the one before it"
                )
            last = scan.stamp
            yield scan
        if self._bad > MOST_BAD * self._points:
            raise RecordingError(
                f"{self.path}: {self._bad / self._points:.0%} of the points of {self.topic} have a time in "
                f"`{self._spans.name}` that is none of their sweep; --time-unit none leaves the times out"
            )

    def pick(self, numbers: Iterable[int]) -> Iterator[tuple[int, Scan]]:
        """Yields some of the scans with their numbers; the others are not decoded."""
        needed = sorted(set(numbers))
        messages = self._source.scans(only=frozenset(one for number in needed for one in self._groups[number]))
        for number in needed:
            yield number, join_scans([self.convention.apply(next(messages))[0] for _ in self._groups[number]])

    def _timed(self, convention: Convention, raw: RawScan) -> Scan:
        """Return a sweep by the convention, and count what has no time in it."""
        scan, bad = convention.apply(raw)
        self._points, self._bad = self._points + len(raw.points), self._bad + bad
        if self._bad:
            self.facts["points_without_time"] = self._bad
        return scan

    def peek(self) -> dict[str, Any]:
        """Return `facts` with the meaning of the times; reads all headers.

        Raises `RecordingError` where no scan has a return, or one is damaged.
        """
        if not self._spans.points:  # a sensor that is starting up sends empty sweeps
            raise RecordingError(f"{self.path}: {self.topic} holds no scan with a return in it")
        _ = self.convention
        return self.facts
