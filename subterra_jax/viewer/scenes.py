"""Which tunnel is on the stage: the plan or the lining at once, every detail as soon as it has been read."""

import threading
from collections.abc import Callable

from subterra_jax.errors import SubterraError
from subterra_jax.viewer.course import Course
from subterra_jax.viewer.library import Library, course_plan
from subterra_jax.viewer.scenery import lining_shape, scene_shapes
from subterra_jax.viewer.shapes import planar_shapes
from subterra_jax.viewer.stage import Stage


class Scenes:
    """Puts tunnels on a stage.

    Args:
        stage: Where they are shown.
        library: Where they come from.
        complain: Called with a sentence where the details of a scene cannot be read.
    """

    def __init__(self, stage: Stage, library: Library, complain: Callable[[str], None]):
        self._stage, self._library, self._complain = stage, library, complain
        self._shown: tuple[str, str, float] | None = None
        self.cutaway = True

    def lining_of(self, title: str, wanted: str) -> str:
        """The variant to show: the wanted one, or the only one there is.

        Raises:
            TunnelError: The tunnel has several, and not that one.
        """
        plan = self._library.plan(title)
        if len(plan.linings) == 1:
            return next(iter(plan.linings))
        plan.lining(wanted)
        return wanted

    def show(self, title: str, lining: str, length: float) -> Course:
        """Shows a tunnel, as far as an episode goes in it.

        Args:
            title: The tunnel.
            lining: Variant of its walls.
            length: Length of the course, m; of a scene the whole is shown all the same.

        Raises:
            SubterraError: A file cannot be read.
        """
        plan, scene = self._library.plan(title), self._library.tunnels[title].scene
        course = Course(course_plan(plan, length))
        wanted = (title, lining, -1.0 if scene is not None else length)
        if wanted == self._shown:
            return course
        if scene is None:
            self._stage.set_tunnel(planar_shapes(course.plan, lining), cutaway=self.cutaway)
        else:
            self._stage.set_tunnel([lining_shape(scene, lining)], cutaway=self.cutaway)
            threading.Thread(target=self._detail, args=(wanted,), daemon=True).start()
        self._shown = wanted
        return course

    def note(self, title: str) -> str:
        """What must be said of the picture of a tunnel; nothing of a scene, which is shown as it was built."""
        planar = self._library.tunnels[title].scene is None
        return "walls pulled up from the plan at LiDAR height" if planar else ""

    def set_cutaway(self, cutaway: bool) -> None:
        """Draws walls from within only, or from both sides."""
        self.cutaway = cutaway
        self._stage.set_cutaway(cutaway)

    def _detail(self, wanted: tuple[str, str, float]) -> None:
        """Replaces a bare lining by everything there is."""
        title, lining, _ = wanted
        scene = self._library.tunnels[title].scene
        assert scene is not None
        try:
            shapes = scene_shapes(scene, lining)
            if lining == "smooth":
                shapes = [lining_shape(scene, lining), *shapes]
        except SubterraError as error:
            self._complain(str(error))
            return
        if self._shown == wanted:
            self._stage.set_tunnel(shapes, cutaway=self.cutaway)
