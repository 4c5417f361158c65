"""What a survey does not show of a track that was laid: sleepers by standard, and gauges read off blurred rails."""

from scene.fitting.trackseen import SeenTrack
from scene.judging.judge import Warned
from scene.writing.track import Track

_FEW = 0.5  # share of the sleepers seen: with fewer, their places are the spacing's


def doubt_track(track: Track, seen: SeenTrack) -> list[Warned]:
    """Return what nobody saw of a track that the survey shows in part.

    Args:
        track: Tracks as laid.
        seen: Tracks as the survey shows them; a ring survey can show none, and nothing is said of it.
    """
    if track.config.lay != "auto" or not seen.sought or len(seen.lines) != len(track.lines):
        return []
    count, measured = len(track.measured), int(track.measured.sum())
    if not count or measured >= _FEW * count:
        return []
    told = "none of them was seen" if not measured else f"only {measured} of them were seen"
    return [Warned(
        "sleepers",
        f"{count} sleepers lie where a spacing of {_spacing(track):.2f} m asks for them, and {told}: the returns "
        "between the rails are too few, or lie too even, to tell them; --track none leaves the track out",
    )]  # fmt: skip


def _spacing(track: Track) -> float:
    """Mean distance of neighbouring sleepers, m."""
    lines = [line.sleeper_station for line in track.lines if len(line.sleeper_station) > 1]
    return float(sum(line[-1] - line[0] for line in lines) / max(sum(len(line) - 1 for line in lines), 1))
