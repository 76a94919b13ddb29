"""The robot tracker as a camera: each look is a picture, rendered and searched by the detector of a data sheet.

Around each robot's mast the camera looks in one of a few fixed directions, `pan_step_rad` apart: a ring of fixed
cameras with one optical centre, or a pan head with stops. Either knows its directions exactly. The picture is taken in
the direction nearest to the target (a team that saw each other a moment ago knows which); where in that picture the
target is, only the detector says.

What is simulated: perspective, lens, the robot's body, light that shines from one side of the world all run long,
clutter that changes from picture to picture, blur by the robots' motion during the exposure, noise. What is not: walls
of the polygonal world in the background (contact breaks where the simulator says, as with statistical trackers),
targets in the other cameras, a third robot that stands between two (it is not drawn, and hides nothing), and a
mirror's exchange of left and right (a reflection looks like a robot that stands there).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from math import ceil, log2, pi

import numpy as np

from coopslam.records import BearingRangeFix, RelativePoseFix
from coopslam.se2 import Pose2, planar_rotation, position, wrap
from sim.sensors import AT_REST, Circumstances, Sensors
from sim.vision_settings import VisionSettings
from tracker.camera import Camera
from tracker.data_sheet import DataSheet
from tracker.detector import Detection, Detector
from tracker.detectors import make_detector
from tracker.helix import Helix
from tracker.render import BEHIND_M, RenderSettings, render
from tracker.scene_light import Light
from tracker.sensor import Sensor
from tracker.tag_cube import TagCube

MOST_BLUR_PX = 200.0
MOST_LOOKS = 50  # in a row for the bearing of a robot that comes by


class Eye:
    """One camera direction with its detector: takes a picture of a robot and says what the detector finds in it."""

    def __init__(self, sheet: DataSheet, settings: VisionSettings, rng: np.random.Generator):
        self.camera, self.target = sheet.camera, sheet.target
        self.settings, self.rng = settings, rng
        self._detector: Detector = make_detector(sheet)
        self._sun = Light(rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.6), rng.uniform(-pi, pi), rng.uniform(0.2, 1.2))
        self._background = cache(self._drawn_background)

    def look(self, T_observer_target: Pose2, seen: Circumstances) -> Detection | None:
        """What one picture shows of a target."""
        T_body_view = self._view(T_observer_target)
        yaw = T_body_view.theta()
        picture = self.picture(T_body_view.between(T_observer_target), yaw, seen)
        found = self._detector.detect(picture)
        if found is None:
            return None
        turn = planar_rotation(yaw)
        return replace(
            found,
            T_observer_target=T_body_view * found.T_observer_target,
            cov_observer=turn @ found.cov_observer @ turn.T,
            features_px=(),
        )

    def picture(self, T_view_target: Pose2, yaw_rad: float, seen: Circumstances) -> np.ndarray:
        """(H, W) uint8 taken in the direction yaw_rad of the body; the target in the axes of that direction."""
        heading = float(wrap(seen.observer_heading_rad + yaw_rad))
        light = replace(self._sun, azimuth_rad=float(wrap(self._sun.azimuth_rad - heading)))
        velocity = planar_rotation(-yaw_rad)[:2, :2] @ seen.velocity_m_per_s
        way_m = velocity * self.settings.exposure_s
        sensor = motion_blurred(self.settings.sensor, self.camera, self.target, T_view_target, way_m)
        settings = RenderSettings(light, self.settings.background, sensor)
        apart_m = T_view_target.range(self.camera.mount.position_body[:2])
        depth = max(0, ceil(2 * log2(apart_m + BEHIND_M)))
        background = self._background(depth, int(self.rng.integers(self.settings.backgrounds)))
        return render(self.camera, self.target, T_view_target, settings, self.rng, background)

    def _view(self, T_observer_target: Pose2) -> Pose2:
        """Body of the robot turned about the optical centre, so that the camera looks into its direction."""
        centre = Pose2(*self.camera.mount.position_body[:2], 0.0)
        step = self.settings.pan_step_rad
        bearing = float(np.arctan2(*position(centre.between(T_observer_target))[::-1])) - self.camera.mount.yaw_rad
        return centre * Pose2(0.0, 0.0, step * round(bearing / step)) * centre.inverse()

    def _drawn_background(self, depth: int, number: int) -> np.ndarray:
        """(H, W) float32; nothing upright nearer than 2 ** (depth / 2) m. `number` tells those of one depth apart."""
        return self.settings.background.radiance(self.camera, self.rng, 2.0 ** (depth / 2))


def motion_blurred(
    sensor: Sensor, camera: Camera, target: Helix | TagCube, T_observer_target: Pose2, way_m: np.ndarray
) -> Sensor:
    """The sensor with the line that the middle of a target draws while it goes a (2,) way in the observer's axes."""
    start = np.array([*position(T_observer_target), target.extent()[:, 2].mean()])
    pixels, _ = camera.project(np.stack([start, start + [*way_m, 0.0]]))
    line = pixels[1] - pixels[0]
    if not np.isfinite(line).all():
        return sensor
    length, direction = float(np.hypot(*line)), float(np.arctan2(line[1], line[0]))
    return replace(sensor, motion_px=min(length, MOST_BLUR_PX), motion_rad=direction)


@dataclass(frozen=True, slots=True)
class VisionSensors(Sensors):
    """Odometry and corner finder as ever; the robot tracker is an eye."""

    eye: Eye | None = None

    @property
    def may_withhold_headings(self) -> bool:
        """See Sensors."""
        return True

    def _fix(
        self, stamp_s: float, observer: str, target: str, shown: Pose2, seen: Circumstances
    ) -> RelativePoseFix | BearingRangeFix | None:
        """See Sensors."""
        found = self._found(shown, seen)
        if found is None:
            return None
        known = found.heading_known and self.tracker_limits.has_heading
        return replace(found, heading_known=known).record(stamp_s, observer, target)

    def bearing_error(self, T_observer_target: Pose2 | None = None, seen: Circumstances = AT_REST) -> float | None:
        """See Sensors.  Of the first picture that shows the target; None when none does.

        Nearer than the camera sees, the last bearing seen counts: that of a picture at the nearest distance.
        """
        if T_observer_target is None:
            return 0.0
        x, y = position(T_observer_target)
        bearing, range_m = float(np.arctan2(y, x)), float(np.hypot(x, y))
        nearest_m = max(range_m, self.tracker_limits.min_range_m)
        there = Pose2(nearest_m * np.cos(bearing), nearest_m * np.sin(bearing), T_observer_target.theta())
        for _ in range(MOST_LOOKS):
            found = self._found(there, seen)
            if found is not None:
                x, y = position(found.T_observer_target)
                return float(wrap(np.arctan2(y, x) - bearing))
        return None

    def contact_seems_lost(self, confirmations: int, seen_again: Callable[[], bool] | None = None) -> bool:
        """See Sensors: so many pictures are taken, until one shows the target."""
        return seen_again is not None and not any(seen_again() for _ in range(confirmations))

    def _found(self, shown: Pose2, seen: Circumstances) -> Detection | None:
        found = self.eye.look(shown, seen)
        self.tally["pictures"] += 1
        self.tally["detections"] += found is not None
        self.tally["headings_withheld"] += found is not None and not found.heading_known
        return found
