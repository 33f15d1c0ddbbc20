"""The description of a simulated world: what a scene file may say, with units and defaults.

Positions are metres in the world frame (x, y on the floor, z up), angles degrees, counter-
clockwise. `at` is the middle of a thing's footprint.
"""

from __future__ import annotations

from dataclasses import dataclass, field

Point = tuple[float, float]
Point3 = tuple[float, float, float]


@dataclass(frozen=True)
class Wall:
    """A chain of upright walls along the centre line `points`; `closed` joins the ends. posters:
    how many sheets hang on it, at random places on both sides.
    """

    points: tuple[Point, ...]
    texture: str = 'plaster'
    height_m: float = 2.5
    thickness_m: float = 0.1
    bottom_m: float = 0.0
    closed: bool = False
    posters: int = 0


@dataclass(frozen=True)
class Box:
    """A block of `size` (length along its heading, width, height), `bottom_m` above the floor."""

    at: Point
    size: Point3
    texture: str = 'wood'
    yaw_deg: float = 0.0
    bottom_m: float = 0.0


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder."""

    at: Point
    radius_m: float
    height_m: float
    texture: str = 'metal'
    bottom_m: float = 0.0


@dataclass(frozen=True)
class Furniture:
    """A composed thing: `kind` is chair, table, stool, guitar or plant."""

    kind: str
    at: Point
    yaw_deg: float = 0.0


@dataclass(frozen=True)
class Slope:
    """A strip of floor from `start` to `end` (x, y, z), `width_m` wide: a ramp, or a platform
    where both heights are equal.
    """

    start: Point3
    end: Point3
    width_m: float
    texture: str = 'concrete'


@dataclass(frozen=True)
class FloorPatch:
    """A part of the flat floor that looks different."""

    at: Point
    size: Point
    texture: str = 'plain'
    yaw_deg: float = 0.0


@dataclass(frozen=True)
class Mover:
    """What stands at the first of `points` and from `start_s` on moves along them, to and fro or,
    without `returns`, to the last one and stays. stays_s: so long it stands at either end.
    """

    points: tuple[Point, ...]
    speed_m_s: float = 0.8
    start_s: float = 0.0
    returns: bool = True
    stays_s: float = 0.0


@dataclass(frozen=True)
class Person(Mover):
    """Someone who walks."""

    height_m: float = 1.75
    texture: str = 'cloth'


@dataclass(frozen=True)
class Car(Mover):
    """A car of `size` (length, width, height)."""

    speed_m_s: float = 8.0
    returns: bool = False
    size: Point3 = (4.2, 1.8, 1.5)
    texture: str = 'goods'


@dataclass(frozen=True)
class MovingBox(Mover):
    """A block of `size` (length along its way, width, height): a door that slides, or, at 100 m/s,
    a crate that somebody puts down and takes away.
    """

    size: Point3 = (0.9, 0.06, 2.0)
    texture: str = 'wood'


@dataclass(frozen=True)
class Floor:
    """The ground. reflectance: 0 dull to 1 a mirror."""

    texture: str = 'tiles'
    reflectance: float = 0.0


@dataclass(frozen=True)
class Ceiling:
    """What hangs over everything; height 0 leaves it out."""

    height_m: float = 2.5
    texture: str = 'panels'


@dataclass(frozen=True)
class Lighting:
    """Light. levels: pairs (time in s, brightness) between which the brightness is interpolated;
    empty keeps it at 1. ambient: share of the light that comes from everywhere. sun: how bright a
    sun shines, whose shadows are hard; it needs a scene without ceiling. turn_deg: how far around
    the vertical the light comes from another side, as at another time of day.
    """

    ambient: float = 0.65
    sun: float = 0.0
    turn_deg: float = 0.0
    levels: tuple[Point, ...] = ()


@dataclass(frozen=True)
class Vibration:
    """Shaking of the camera: amplitudes of random motion with about this frequency."""

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    bounce_m: float = 0.0
    frequency_hz: float = 3.0


@dataclass(frozen=True)
class CameraRig:
    """The stereo camera. Position and angles are of the left camera on the base; pitch looks
    down, roll to the right. fov_x_deg: of the rectified image. distortion: k1 k2 p1 p2 k3 of the
    raw images, or k1 k2 k3 k4 of a fisheye (equidistant); with one of them, or with
    misalignment_deg (rotation of either raw camera against the rectified pair), the images are
    written unrectified. covered: when something hides the lenses,
    pairs of start and end in seconds.

    What follows in the list is what a real camera does to its images; `kind` in a scene file, or
    `--camera`, names a camera whose values it takes over. noise_sigma: of the readout, in grey
    levels. shot_noise: that of the light, at white; its variance grows with the grey level.
    exposure_s: motion blur. rolling_s: from the readout of the first to that of the last row.
    auto_exposure: share of a change of brightness for which the camera makes up, each eye by what
    it sees. vignetting: share of the light that is lost in the corners. softness_px: deviation of
    the spread of a point. bayer: one colour per pixel. jpeg: quality in percent, 0 for none.

    Of the right eye against the left: right_gain: brightness. row_offset_px: image lower.
    pair_roll_deg: image turned to the right. pair_focal: share by which the focal length is
    larger. lag_s: taken later. drift_s: period in which all of these but the lag swing to their
    opposite and back, 0 for never.
    """

    width: int = 640
    height: int = 480
    fov_x_deg: float = 90.0
    baseline_m: float = 0.12
    height_m: float = 0.3
    forward_m: float = 0.0
    pitch_deg: float = 7.0
    roll_deg: float = 0.0
    rate_hz: float = 10.0
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    misalignment_deg: float = 0.0
    covered: tuple[Point, ...] = ()
    vibration: Vibration = field(default_factory=Vibration)
    noise_sigma: float = 1.5
    shot_noise: float = 0.0
    exposure_s: float = 0.0
    rolling_s: float = 0.0
    auto_exposure: float = 0.0
    gamma: float = 1.0
    vignetting: float = 0.0
    softness_px: float = 0.0
    bayer: bool = False
    jpeg: int = 0
    right_gain: float = 1.0
    row_offset_px: float = 0.0
    pair_roll_deg: float = 0.0
    pair_focal: float = 0.0
    lag_s: float = 0.0
    drift_s: float = 0.0

    @property
    def rectified(self) -> bool:
        """Whether the images come out of the camera rectified."""
        return not (self.fisheye or any(self.distortion) or self.misalignment_deg)


@dataclass(frozen=True)
class Wheels:
    """The wheel odometry of a differential drive; without a rate there is none. scale: metres told
    per metre driven. track_m: between the wheels. noise_m: standard deviation of what a wheel
    tells of one metre. slips: (start s, end s, left, right), factors on what each wheel tells.
    """

    rate_hz: float = 0.0
    scale: float = 1.0
    track_m: float = 0.3
    noise_m: float = 0.003
    slips: tuple[tuple[float, float, float, float], ...] = ()


@dataclass(frozen=True)
class Imu:
    """A gyroscope and accelerometer; without a rate there is none. place_m: where it is in the left
    optical frame, whose axes it has. Noise is the standard deviation of a sample, a bias the length
    of a constant error in a random direction.
    """

    rate_hz: float = 0.0
    gyro_noise_deg_s: float = 0.1
    gyro_bias_deg_s: float = 0.5
    accel_noise_m_s2: float = 0.03
    accel_bias_m_s2: float = 0.05
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class DepthSensor:
    """A depth image aligned with the rectified left image; without a maximum there is none. It is
    measured as a disparity over `baseline_m` with noise, in steps of `step_px`. hole_share: of the
    image without a measurement, in patches; nor is there one of what is darker than dark_grey or
    lighter than shiny_grey. flying_share: of the pixels at edges that have a depth between both
    sides; the others have none. lag_s: how much earlier than the image it was taken.
    """

    max_m: float = 0.0
    min_m: float = 0.3
    baseline_m: float = 0.05
    noise_px: float = 0.08
    step_px: float = 0.0625
    hole_share: float = 0.02
    dark_grey: float = 0.0
    shiny_grey: float = 255.0
    flying_share: float = 0.0
    lag_s: float = 0.0


@dataclass(frozen=True)
class Sensors:
    """What the robot has besides its stereo camera."""

    wheel_odometry: Wheels = field(default_factory=Wheels)
    imu: Imu = field(default_factory=Imu)
    depth: DepthSensor = field(default_factory=DepthSensor)


@dataclass(frozen=True)
class Route:
    """The drive: through `waypoints`, corners rounded over about `smoothing_m`, speeding up and
    braking at `acceleration_m_s2`, slower where it turns faster than `turn_rate_deg_s`.
    """

    waypoints: tuple[Point, ...]
    speed_m_s: float = 0.4
    smoothing_m: float = 0.3
    acceleration_m_s2: float = 0.3
    turn_rate_deg_s: float = 35.0


@dataclass(frozen=True)
class Scene:
    """A world, the camera and the drive through it. robot_height_m: what hangs higher is no
    obstacle in the true map; step_height_m: what is lower is not one either. resolution_m and
    raster_phase: cells of the true map, and where in a cell the outermost corner of the solids
    lies; in the middle (0.5) a wall's face is not a cell's border, which an estimate may round
    to either side.
    """

    description: str
    path: Route
    seed: int = 1
    floor: Floor = field(default_factory=Floor)
    ceiling: Ceiling = field(default_factory=Ceiling)
    walls: tuple[Wall, ...] = ()
    boxes: tuple[Box, ...] = ()
    cylinders: tuple[Cylinder, ...] = ()
    furniture: tuple[Furniture, ...] = ()
    slopes: tuple[Slope, ...] = ()
    floor_patches: tuple[FloorPatch, ...] = ()
    people: tuple[Person, ...] = ()
    cars: tuple[Car, ...] = ()
    moving_boxes: tuple[MovingBox, ...] = ()
    lighting: Lighting = field(default_factory=Lighting)
    camera: CameraRig = field(default_factory=CameraRig)
    sensors: Sensors = field(default_factory=Sensors)
    resolution_m: float = 0.05
    raster_phase: float = 0.5
    robot_height_m: float = 1.0
    step_height_m: float = 0.03

    @property
    def movers(self) -> tuple[Mover, ...]:
        """Everything that moves; it is not part of the true map."""
        return (*self.people, *self.cars, *self.moving_boxes)
