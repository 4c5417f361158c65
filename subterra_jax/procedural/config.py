"""What a family of tunnels is drawn from."""

import dataclasses

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class ProceduralConfig:
    """Ranges of a family of tunnels; every pair is the least and the largest value, drawn uniformly unless said.

    Source: widths and pockets are those of the packaged bore (5.65 m between the walls at LiDAR height, pockets 0.20 m
    long, 0.13 m deep and 0.22 m from the joint), the rest metro practice; radii go down to 60 m where 150 to 300 m are
    usual.

    Attributes:
        length: Of the centreline, m.
        radius: Of a bend, m, drawn uniformly in its logarithm.
        straight: Length between two bends, m.
        arc: Length of constant curvature, m.
        transition: Length of each clothoid, over which the curvature changes evenly, m.
        turn: Most that one bend may turn, without its clothoids, rad.
        reverse_share: Share of bends that go over into the opposite bend without a straight.
        width: Mean distance between the smooth walls, m.
        width_sd: Standard deviation of the width's slow variation along one tunnel, m.
        width_wave: Its correlation length, m.
        roughness: Standard deviation of each wall about its smooth course, m.
        correlation: Correlation length of that roughness, m.
        ring_pitch: From ring joint to ring joint, m.
        pocket_depth: Of the recesses, m.
        pocket_length: Along the wall, m.
        pocket_offset: Of a recess's middle from its joint, m; they come in pairs, one on either side.
        pocket_missing: Share of recesses that are not there.
        one_wall_share: Share of tunnels in which the LiDAR plane crosses a row of recesses on one wall only.
        bracket_spacing: Of the cable brackets on the right wall in the furnished lining, m.
        post_spacing: Of the handrail posts on the left in the furnished lining, m.
        lidar_height: Of the LiDAR plane above the floor, m; for the record, since the family has no third dimension.
        grid_step: Of the chainage grid, m.
        wall_step: Between two vertices of a smooth wall, m.
    """

    length: Range = (200.0, 500.0)
    radius: Range = (60.0, 1000.0)
    straight: Range = (15.0, 70.0)
    arc: Range = (20.0, 90.0)
    transition: Range = (10.0, 30.0)
    turn: float = 1.6
    reverse_share: float = 0.3
    width: Range = (5.085, 6.215)
    width_sd: Range = (0.0, 0.02)
    width_wave: Range = (15.0, 40.0)
    roughness: Range = (0.0, 0.015)
    correlation: Range = (0.5, 3.0)
    ring_pitch: Range = (1.2, 1.5)
    pocket_depth: Range = (0.05, 0.15)
    pocket_length: Range = (0.15, 0.25)
    pocket_offset: Range = (0.18, 0.28)
    pocket_missing: Range = (0.0, 0.3)
    one_wall_share: float = 0.3
    bracket_spacing: Range = (1.8, 2.2)
    post_spacing: Range = (1.8, 2.2)
    lidar_height: float = 0.7
    grid_step: float = 0.25
    wall_step: float = 0.35

    def check(self) -> None:
        """Refuse, naming the field, ranges from which no tunnel can be drawn.

        Raises:
            ValueError: A range is empty or not positive, a share is outside [0, 1], or recesses would overlap.
        """
        may_be_zero = {"width_sd", "roughness", "pocket_missing"}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            low, high = value if isinstance(value, tuple) else (value, value)
            least_ok = low >= 0.0 if field.name in may_be_zero or field.name.endswith("_share") else low > 0.0
            if not (least_ok and low <= high):
                raise ValueError(f"{field.name} of the family must be positive and not empty, got {value}")
            if (field.name.endswith("_share") or field.name == "pocket_missing") and high > 1.0:
                raise ValueError(f"{field.name} of the family must be at most 1, got {value}")
        if self.pocket_length[1] >= min(2.0 * self.pocket_offset[0], self.ring_pitch[0] - 2.0 * self.pocket_offset[1]):
            raise ValueError(
                f"recesses of {self.pocket_length} m at {self.pocket_offset} m from joints "
                f"{self.ring_pitch} m apart would overlap"
            )
