"""The rover as MJCF: a Scout 2.0 on four wheels, commanded by speed and yaw rate. SI; without MuJoCo, for the scenes.

Source, unless another is named: agilexrobotics/scout_ros, scout_description/urdf/scout_v2.xacro (commit 4efdebbe) and
scout_wheel_type1.xacro (commit 2eef7347). Their masses sum up to 82 kg, which is more than the maker's data sheet says.
"""

from xml.etree import ElementTree as ET

# Bits of `contype` in a world, which a robot's geoms have in `conaffinity` where they touch it.
SOLID = 1  # everything that is really there: lining, bed, sleepers, rails, furniture
ROLL = 2  # bed and sleepers, for wheels
GROUND = 4  # bed, sleepers and rails alone, for legs
LOW_WALL = 8  # lining and furniture at robots' height alone, a few panels, so that MJX has few pairs to test
RAIL = 16  # rails, for the fenders of wheels

NAME = "scout"
MASS, INERTIA = 50.0, (2.288641, 5.103976, 3.431465)  # of all but the wheels, kg, kg m²
WHEEL_MASS, WHEEL_INERTIA = 8.0, (0.1171, 0.1361, 0.1171)
HULL_HALF, HULL_UP = (0.4625, 0.19, 0.105), 0.008  # its box, and that box's middle above the origin, m
WHEEL_RADIUS, WHEEL_HALF = 0.16459, 0.058265  # radius and half the width of a wheel, m
WHEELBASE, TRACK, AXLE_UP = 0.498, 0.58306, -0.0702  # between axles and wheels, axles above the origin, m
HEIGHT = WHEEL_RADIUS - AXLE_UP  # of the origin above level ground, m
HALF_SIZE = (0.465, 0.35)  # of the whole robot in plan, m. Source: Scout 2.0 user manual, 930 mm x 699 mm
FRICTION = 0.8  # rubber on concrete, as the B2's feet; inferred
SPEED_MAX = 1.5  # m/s. Source: Scout 2.0 user manual, messages of the serial port
# Of a wheel's motor, N m: the manual's 200 W at that speed are 22 N m; a start takes up to twice as much. Inferred.
TORQUE = 40.0
LAG = 0.25  # of the commands, s: at once, the torque of a start would lift the front wheels. Inferred
# Speed loop of a wheel's motor, N m s/rad, and its rotor behind the gear, kg m². Inferred: a rotor
# of 1.1e-4 kg m2 behind 30:1; scrub costs the robot 3 % of a turn of 0.8 rad/s on the spot.
GAIN, ARMATURE = 150.0, 0.1
# Tyres give way by 2 mm under the robot, by less than 1 cm at a sleeper. Hard wheels hop here when they slide.
TYRE = {"solref": "0.02 1", "solimp": "0.2 0.95 0.006 0.5 2"}
ROLLED = WHEEL_RADIUS - 0.002  # radius that it rolls on with such tyres, m; measured here
# That radius for the odometer on sleepers, calibrated on its ground as real ones are: wheels turn 11 to 13 % too far at
# up to 1 m/s. 6 % is their way up and down, the rest slip, since all four turn alike; measured here in C.
ROLLED_ON_SLEEPERS = ROLLED / 1.12
# A skid-steered robot turns as one of a wider track, since its wheels scrub: where four wheels slide on a level floor,
# 1 + (wheelbase / track)^2 times as wide. Source: that balance of moments; MuJoCo gives 1.74 to 1.81 with these tyres.
SCRUB = 1.0 + (0.498 / 0.58306) ** 2
LIDAR_HEIGHT = 0.7  # above the ground, m; the tasks'
_BUMPER = 0.12  # radius of the balls at the corners that keep the hull out of walls, m
WHEELS = tuple(f"{NAME}_{end}_{side}" for end in ("front", "rear") for side in ("left", "right"))
BUMPERS = tuple(f"{wheel}_bumper" for wheel in WHEELS)


def rover_mjcf(lidar_height: float = LIDAR_HEIGHT) -> ET.Element:
    """Return a model of the rover alone: body with free joint, tendons, the two motors and the inertial sensors.

    MJX knows no cylinder on a box, and MuJoCo's climbs rails by its edges. So wheels are balls on bed and sleepers, and
    at rails fenders as wide as their treads, which do not turn.

    Args:
        lidar_height: Height of its LiDAR above the ground, m.
    """
    root = ET.Element("mujoco", model=NAME)
    body = _add(_add(root, "worldbody"), "body", name=NAME, pos=f"0 0 {HEIGHT:.6g}")
    _add(body, "freejoint", name=NAME)
    _add(body, "inertial", pos="0 0 0", mass=f"{MASS:g}", diaginertia=_text(*INERTIA))
    solid = {"contype": "0", "group": "2", "mass": "0", "rgba": "0.90 0.42 0.08 1"}
    _add(
        body, "geom", name=f"{NAME}_hull", type="box", size=_text(*HULL_HALF), pos=_text(0, 0, HULL_UP),
        conaffinity="0", **solid,
    )  # fmt: skip
    for wheel, bumper, (x, y) in zip(WHEELS, BUMPERS, ((1, 1), (1, -1), (-1, 1), (-1, -1)), strict=True):
        at = _text(x * (HALF_SIZE[0] - _BUMPER), y * (HALF_SIZE[1] - _BUMPER), 0)
        rest = {**solid, "group": "3", "condim": "1", "priority": "1", "conaffinity": str(LOW_WALL), "solref": "0.01 1"}
        _add(body, "geom", name=bumper, type="sphere", size=f"{_BUMPER:g}", pos=at, **rest)
        _add_wheel(body, wheel, (x * WHEELBASE / 2, y * TRACK / 2, AXLE_UP))
    up = lidar_height - HEIGHT
    _add(
        body, "geom", name=f"{NAME}_mast", type="cylinder", size="0.03", fromto=_text(0, 0, HULL_HALF[2], 0, 0, up),
        conaffinity="0", **{**solid, "rgba": "0.2 0.2 0.22 1"},
    )  # fmt: skip
    _add(body, "site", name="lidar", pos=_text(0, 0, up), size="0.04")
    _add(body, "site", name="imu", pos="0 0 0", size="0.02")
    _add(body, "camera", name=NAME, pos="0 0 0.8", xyaxes="0 -1 0 0.1 0 1", fovy="70")
    _add(body, "camera", name="chase", pos="-4 0 2", xyaxes="0 -1 0 0.22 0 1", fovy="60")
    _add_drive(root)
    sensors = _add(root, "sensor")
    for kind in ("gyro", "accelerometer"):
        _add(sensors, kind, name=kind, site="imu")
    return root


def _add_wheel(body: ET.Element, name: str, at: tuple[float, ...]) -> None:
    wheel = _add(body, "body", name=name, pos=_text(*at))
    _add(wheel, "inertial", pos="0 0 0", mass=f"{WHEEL_MASS:g}", diaginertia=_text(*WHEEL_INERTIA))
    limit = _text(-TORQUE, TORQUE)
    _add(
        wheel,
        "joint",
        name=name,
        axis="0 1 0",
        armature=f"{ARMATURE:g}",
        actuatorfrclimited="true",
        actuatorfrcrange=limit,
    )
    touch = {"contype": "0", "mass": "0", "condim": "3", "priority": "1", "friction": _text(FRICTION, 0.005, 0.0001)}
    look = {"group": "2", "rgba": "0.15 0.15 0.16 1", "zaxis": "0 1 0"}
    tread = {"type": "cylinder", "size": _text(WHEEL_RADIUS, WHEEL_HALF)}
    ball = {"type": "sphere", "size": f"{WHEEL_RADIUS:g}", "group": "3", "zaxis": "0 1 0"}
    _add(wheel, "geom", name=name, conaffinity=str(ROLL), **ball, **touch, **TYRE)
    _add(wheel, "geom", name=f"{name}_look", contype="0", conaffinity="0", mass="0", **tread, **look)
    reach = WHEEL_RADIUS - WHEEL_HALF
    ends = _text(at[0] - reach, *at[1:], at[0] + reach, *at[1:])
    fender = {"type": "capsule", "size": f"{WHEEL_HALF:g}", "fromto": ends, "group": "3"}
    _add(body, "geom", name=f"{name}_fender", conaffinity=str(RAIL), **fender, **touch)


def _add_drive(root: ET.Element) -> None:
    """Add the motors: tendons sum up the wheels' speeds, so that the controls are speed (m/s) and yaw rate (rad/s).

    Together they are a speed loop of the same gain on each wheel: two on the sums, two dampers on the differences
    between front and rear.
    """
    wide, tendons, motors = SCRUB * TRACK, _add(root, "tendon"), _add(root, "actuator")
    fraction = {"speed": ROLLED / 4, "yaw_rate": ROLLED / (2 * wide)}
    # A wheel at full speed turns the robot on the spot by the same speed over half the track.
    most = {"speed": SPEED_MAX, "yaw_rate": 2 * SPEED_MAX / wide}
    for name, gain in (("speed", 4 * GAIN / ROLLED**2), ("yaw_rate", GAIN * (wide / ROLLED) ** 2)):
        tendon = _add(tendons, "fixed", name=name)
        for k, wheel in enumerate(WHEELS):
            sign = -1 if name == "yaw_rate" and k % 2 == 0 else 1
            _add(tendon, "joint", joint=wheel, coef=f"{sign * fraction[name]:.8g}")
        limits = {"ctrllimited": "true", "ctrlrange": _text(-most[name], most[name])}
        loop = {"gainprm": f"{gain:.8g}", "biastype": "affine", "biasprm": f"0 0 {-gain:.8g}"}
        _add(motors, "general", name=name, tendon=name, dyntype="filterexact", dynprm=f"{LAG:g}", **loop, **limits)
    for side in ("left", "right"):
        tendon = _add(tendons, "fixed", name=f"{side}_difference", damping=f"{2 * GAIN:g}")
        for end, half in (("front", 0.5), ("rear", -0.5)):
            _add(tendon, "joint", joint=f"{NAME}_{end}_{side}", coef=f"{half:g}")


def _add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    return ET.SubElement(parent, tag, attributes)


def _text(*numbers: float) -> str:
    return " ".join(f"{number:.8g}" for number in numbers)
