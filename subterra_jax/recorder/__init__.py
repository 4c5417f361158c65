"""An episode as a recording that SLAM programs read: ROS 2 messages in an MCAP file, poses as TUM, the truth apart."""

from subterra_jax.recorder.config import RecorderConfig, RecorderError
from subterra_jax.recorder.record import record

__all__ = ["RecorderConfig", "RecorderError", "record"]
