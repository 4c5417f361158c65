"""Warnings of a track that was laid beyond what was seen: sleepers by standard, gauges read off blurred rails."""

from scene.fitting.trackseen import SeenTrack
from scene.judging.codes import Code
from scene.judging.judge import Warned
from scene.writing.track import Track

_FEW = 0.5  # share of the sleepers seen: with fewer, their places are the spacing's

_THIN = "the returns on the floor are too few to show any, or their sleepers: a track is easily missed"


def doubt_track(track: Track, seen: SeenTrack, pose_doubt: str | None = None) -> list[Warned]:
    """Return what nobody saw of a track that the survey shows in part, or could not show.

    Args:
        track: Tracks as laid.
        seen: Tracks as the survey shows them; a ring survey can show none, and nothing is said of it.
        pose_doubt: Sentence on poses that blur the walls; `None` where they do not.
    """
    sought = track.config.lay == "auto" and seen.sought
    if sought and all(line.rails is None for line in seen.lines) and (pose_doubt or seen.thin):
        why = f"{pose_doubt}: rails blur as the walls do, and may be there" if pose_doubt else _THIN
        return [Warned(Code.RAILS, f"no rails were seen, but {why}; --track standard lays a track")]
    left_out = sum(line.left_out for line in track.lines)
    if left_out:
        return [Warned(
            Code.SLEEPERS,
            f"{left_out} sleepers are left out: {track.config.sleeper_length:g} m long, they would come within "
            f"{track.config.margin:g} m of a wall; --track.sleeper-length gives them the length that is there",
        )]  # fmt: skip
    if track.config.lay != "auto" or not seen.sought or len(seen.lines) != len(track.lines):
        return []
    count, measured = len(track.measured), int(track.measured.sum())
    if not count or measured >= _FEW * count:
        return []
    told = "none of them was seen" if not measured else f"only {measured} of them were seen"
    return [Warned(
        Code.SLEEPERS,
        f"{count} sleepers lie where a spacing of {_spacing(track):.2f} m asks for them, and {told}: the returns "
        "between the rails are too few, or lie too even, to tell them; --track none leaves the track out",
    )]  # fmt: skip


def _spacing(track: Track) -> float:
    """Mean distance of neighbouring sleepers, m."""
    lines = [line.sleeper_station for line in track.lines if len(line.sleeper_station) > 1]
    return float(sum(line[-1] - line[0] for line in lines) / max(sum(len(line) - 1 for line in lines), 1))
