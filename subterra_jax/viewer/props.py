"""What stands still in the scene: the lamps, the gate at the goal, the obstacles."""

import numpy as np
import viser

from subterra_jax.viewer.frames import Film

_GOAL, _BOX = (60, 200, 120), (150, 96, 60)
_BOX_HEIGHT = 1.1  # m; the LiDAR is lower, and the file says nothing of it


def light(scene: viser.SceneApi) -> None:
    """Even light with a little direction: no lamp outside lights the inside of a tunnel, were there shadows."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(hdri=None)
    scene.add_light_hemisphere("/light/all", sky_color=(255, 250, 242), ground_color=(120, 116, 112), intensity=2.4)
    scene.add_light_directional("/light/side", intensity=1.3, position=(0.4, -0.7, 0.6))
    scene.add_light_directional("/light/other", intensity=0.5, position=(-0.6, 0.5, 0.3))


def gate(scene: viser.SceneApi, film: Film) -> list[viser.SceneNodeHandle]:
    """A gate at the goal that says its station; nothing where there is no goal."""
    posts = film.goal()
    if not len(posts):
        return []
    text = f"goal, {film.recording.goal:.1f} m"
    return [
        scene.add_line_segments("/goal", posts.astype(np.float32), _GOAL, thickness=0.08),
        scene.add_label("/goal label", text, position=posts[1:3, 0].mean(axis=0), anchor="bottom-center"),
    ]


def boxes(scene: viser.SceneApi, film: Film) -> list[viser.SceneNodeHandle]:
    """The obstacles."""
    plan = film.course.plan
    made: list[viser.SceneNodeHandle] = []
    for index, (x, y, cos, sin, half_long, half_wide) in enumerate(film.recording.boxes.astype(float)):
        ground = float(plan.elevation[np.argmin(np.sum((plan.centre - (x, y)) ** 2, axis=1))])
        made.append(
            scene.add_box(
                f"/boxes/{index}",
                color=_BOX,
                dimensions=(2.0 * half_long, 2.0 * half_wide, _BOX_HEIGHT),
                position=(x, y, ground + 0.5 * _BOX_HEIGHT),
                wxyz=about_z(float(np.arctan2(sin, cos))),
                cast_shadow=False,
            )
        )
    return made


def about_z(angle: float) -> tuple[float, float, float, float]:
    """A turn about the vertical as a quaternion, scalar first."""
    return float(np.cos(0.5 * angle)), 0.0, 0.0, float(np.sin(0.5 * angle))
