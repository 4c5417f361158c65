"""Masses, dimensions and limits of the Unitree B2, each with its source. SI; quaternions with the real part first.

Unitree publishes three models that disagree: 74.58 kg (URDF), 83.50 kg (unitree_mujoco counts each thigh's cover twice)
and 69.00 kg (unitree_ros' MJCF drops head, tail and rotors from the trunk but keeps their inertia); the data sheet says
about 60 kg. The URDF is taken: it is the newest and the only one whose masses and inertias belong together. Training
draws the mass from a range that reaches down to the data sheet's.

Source, unless another is named: unitreerobotics/unitree_ros, robots/b2_description/urdf/b2_description.urdf, commit
d2a7facd, masses of fixed links lumped into their parents.
"""

import dataclasses

LEGS = ("FL", "FR", "RL", "RR")
PARTS = ("hip", "thigh", "calf")
JOINTS = tuple(f"{leg}_{part}_joint" for leg in LEGS for part in PARTS)

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Inertial:
    """Mass and inertia of one body."""

    mass: float  # mass, kg
    com: Vector  # centre of mass in the body's frame, m
    # inertia xx, yy, zz, xy, xz, yz about the centre of mass, along the body's axes, kg m²
    inertia: tuple[float, float, float, float, float, float]

    def mirrored(self, left: bool, front: bool) -> "Inertial":
        """Return this part of the front left leg mirrored to another leg."""
        y, x = (1.0 if left else -1.0), (1.0 if front else -1.0)
        xx, yy, zz, xy, xz, yz = self.inertia
        com = (x * self.com[0], y * self.com[1], self.com[2])
        return Inertial(self.mass, com, (xx, yy, zz, x * y * xy, x * xz, y * yz))


TRUNK = Inertial(
    41.4371,
    (0.0234668098, 0.00454731996, 0.0114076538),
    (0.35833829, 1.70381349, 1.76262643, 0.0041202944, -0.132988072, 0.000657680078),
)
# Front left leg: the mean of the four, mirrored. The four differ by up to 2.5 mm in the hip's centre of mass.
HIP = Inertial(
    2.9464,
    (-0.00596308342, -0.00949322427, 0.000119751561),
    (0.00312619516, 0.00493058891, 0.00384114378, 0.000128857628, -3.26385359e-06, -3.50440031e-06),
)
THIGH = Inertial(
    4.8094,
    (-0.00592205764, -0.0335174151, -0.0545472533),
    (0.0634780624, 0.0624162703, 0.0086449951, 0.000919631728, -0.0037411221, 0.00873890886),
)
CALF = Inertial(
    0.53,
    (0.00792094717, 5.16980377e-06, -0.180894536),
    (0.016779055, 0.016920483, 0.000407428429, 3.95434775e-08, 0.000226390007, 4.91142815e-07),
)
TOTAL_MASS = TRUNK.mass + 4.0 * (HIP.mass + THIGH.mass + CALF.mass)


def inertial(leg: str, part: str) -> Inertial:
    """Return mass and inertia of one part of a leg; hind thighs and calves equal the front ones, hips are mirrored."""
    front_left = {"hip": HIP, "thigh": THIGH, "calf": CALF}[part]
    return front_left.mirrored(leg in ("FL", "RL"), part != "hip" or leg in ("FL", "FR"))


GRAVITY = 9.81  # m/s²
FOOT_FRICTION = 0.8  # on any material; rubber on concrete, where the MJCFs say 0.4

# Geometry, m.
HIP_X, HIP_Y = 0.3285, 0.072  # of the abduction axis from the middle of the trunk
THIGH_Y = 0.11973  # from the abduction axis to the leg's plane
LINK = 0.35  # thigh and shank alike
FOOT_RADIUS = 0.032
ENVELOPE = (1.098, 0.450, 0.645)  # standing. Source: docs.westonrobot.com/robot_user_guide/unitree/b2.html


@dataclasses.dataclass(frozen=True)
class Joint:
    """Properties of one kind of joint."""

    axis: Vector  # axis in the body's frame
    low: float  # least angle, rad
    high: float  # largest angle, rad
    torque: float  # largest torque, N m
    speed: float  # largest speed, rad/s
    # Inertia of the rotor seen through the gear, kg m². Inferred: the URDF's rotor (2.63e-4 kg m²) through ratios of 15
    # and 24, those of Unitree's motors of the same torque (M107-15, M107-24 of the H1-2).
    armature: float
    stiffness: float  # stiffness of the position servo, N m/rad
    damping: float  # damping of the position servo, N m s/rad


# Gains: with the 160/5 that Isaac's configurations give the B2, the zero action collapses under 75 kg; with these it
# stands (base at 0.505 m). Torque of the calf: 320 N m (URDF, robot_lab), where the MJCFs say 300.
JOINT = {
    "hip": Joint((1.0, 0.0, 0.0), -0.87, 0.87, 200.0, 23.0, 0.0592, 300.0, 10.0),
    "thigh": Joint((0.0, 1.0, 0.0), -0.94, 4.69, 200.0, 23.0, 0.0592, 300.0, 10.0),
    "calf": Joint((0.0, 1.0, 0.0), -2.82, -0.43, 320.0, 14.0, 0.1515, 400.0, 10.0),
}
# Source: robot_lab's default pose. The feet stand 2.6 cm behind the hips.
STAND = {"hip": 0.0, "thigh": 0.8, "calf": -1.5}
STAND_HEIGHT = 0.5435  # of the trunk's middle over the feet's soles in that pose, m

# Frame in the trunk's frame, m.
LIDAR = (0.34218, 0.0, 0.17851)
# Balls at either end of the trunk that are kept out of walls; together they are the envelope in plan, m.
BUMPER_X, BUMPER_RADIUS = 0.33, 0.225
BUMPERS = ("bumper_front", "bumper_rear")
