"""How well any detector can measure a robot in a picture: the Cramer-Rao bound that the noise of the pixels sets.

The mean picture mu(p) depends on x, y, theta and on nuisances that nobody knows either: ambient and direct light (with
them the gain), brightness of the surroundings, black level, defocus and length of the motion blur. Pixels are
independent, and Gaussian to good approximation, with the variance v of the sensor's noise and of rounding. Then

    information = J^T V^-1 J,   J = d mu / d p,   V = diag(v)

(Kay 1993, section 3.9; what v itself tells of p is less than a thousandth of that and left out), and what is left for
the pose when the nuisances are estimated with it is the Schur complement. J comes from central differences of the
renderer without noise. Known are the target, the camera, the direction of the light and the picture of the
surroundings up to its brightness: a detector knows less than that, so it does not reach the bound at silhouettes. Of
the robot only the marked solid counts, which is what a detector is told of.
"""

from dataclasses import dataclass, replace

import numpy as np

from coopslam.se2 import Pose2, position, rotation
from tracker.antialias import CELLS
from tracker.camera import Camera
from tracker.render import RenderSettings, render, target_box
from tracker.sensor import Sensor
from tracker.target import Solid, Target

# How far a difference moves the fastest point of the marked solid; an edge alone in a cell is rendered true to 0.001.
STEP_PX = 0.15
PROBE = 1e-4  # m or rad, to find that out
DEFOCUS_STEP_PX = 0.05
MOTION_STEP_PX = 0.1
UNSEEN = 1e-3
DEPENDENT = 1e-4  # nuisances that differ by less differ by the rounding of the renderer
ROUNDING = 1 / 12  # variance of a uniform error, grey levels^2
LARGEST = 255.0


@dataclass(frozen=True, slots=True)
class _Film(Sensor):
    """Keeps the radiance that falls on it."""

    def picture(self, radiance: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        return radiance


@dataclass(frozen=True, slots=True)
class _Marked:
    """What a detector is told of a target."""

    solids: tuple[Solid, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """The part of the picture in which the target is, and as much around it as blur reaches."""

    drawn: tuple[slice, slice]  # of the cells
    read: tuple[slice, slice]  # of the pixels that are drawn: beyond it, blur would need what is not drawn
    vignette: np.ndarray  # share of the light that arrives, of the pixels that are drawn

    def exposed(self, radiance: np.ndarray, sensor: Sensor) -> np.ndarray:
        """(P,) grey levels before noise and rounding, from the radiance of the drawn part."""
        even = replace(sensor, vignetting=0.0, black_level=0.0)
        return (even.exposed(radiance) * self.vignette + sensor.black_level)[self.read].ravel().astype(float)


def pose_bound(
    camera: Camera, target: Target, T_observer_target: Pose2, settings: RenderSettings, background: np.ndarray
) -> np.ndarray | None:
    """(3, 3) least covariance of an unbiased measurement of x, y, theta; axes of the observer; m, m, rad.

    background: (H, W) radiance behind the target, as for `render`.  None when the picture does not tie down the pose.
    """
    information = pose_information(camera, target, T_observer_target, settings, background)
    if information is None or np.linalg.cond(information) > 1e12:
        return None
    return np.linalg.inv(information)


def pose_information(
    camera: Camera, target: Target, T_observer_target: Pose2, settings: RenderSettings, background: np.ndarray
) -> np.ndarray | None:
    """(3, 3) Fisher information of x, y, theta in the observer's axes, nuisances marginalized; None: not in view."""
    target = _Marked(target.solids[:1])
    moves = _moves(camera, target, T_observer_target)
    if moves is None:
        return None
    poses = [_moved(T_observer_target, sign * step) for step in moves for sign in (1, -1)]
    window = _window(camera, target, [T_observer_target, *poses], settings.sensor)
    if window is None:
        return None
    sensor, film = settings.sensor, replace(settings, sensor=_Film())

    def seen(pose: Pose2, light) -> np.ndarray:
        with_light = replace(film, light=light)
        return render(camera, target, pose, with_light, None, background)[window.drawn]

    radiance = seen(T_observer_target, settings.light)
    grey = window.exposed(radiance, sensor)
    ahead_back = [window.exposed(seen(pose, settings.light), sensor) for pose in poses]
    by_move = np.stack([(ahead_back[k] - ahead_back[k + 1]) / 2 for k in (0, 2, 4)], axis=1)
    by_nuisance = _by_nuisance(window, radiance, seen, T_observer_target, settings)
    unclipped = (grey > 0) & (grey < LARGEST)
    moved = marginal_information(by_move[unclipped], by_nuisance[unclipped], pixel_variance(sensor, grey[unclipped]))
    to_moves = np.linalg.inv(moves.T)
    return to_moves.T @ moved @ to_moves


def marginal_information(jacobian: np.ndarray, nuisance: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(n, n) information of n parameters when m nuisances are estimated with them.

    jacobian: (P, n), nuisance: (P, m) derivatives of P independent measurements; variance: (P,) of their noise.
    The Schur complement, as what is left of the Jacobian after regression on the nuisances: dependent ones do no harm.
    A nuisance that would have to change by 1 / UNSEEN to be one sigma of the picture is left out: rounding errors.
    """
    whitened, other = (each / np.sqrt(variance)[:, None] for each in (jacobian, nuisance))
    scale = np.linalg.norm(other, axis=0)
    other = other[:, scale > UNSEEN] / scale[scale > UNSEEN]
    left = whitened - other @ np.linalg.lstsq(other, whitened, rcond=DEPENDENT)[0] if other.size else whitened
    return left.T @ left


def pixel_variance(sensor: Sensor, grey: np.ndarray) -> np.ndarray:
    """Variance of pixels whose mean grey level is `grey`: photons, read-out and rounding; grey levels^2."""
    signal = np.maximum(grey - sensor.black_level, 0.0)
    read = (sensor.read_noise_electrons / sensor.electrons_per_level) ** 2
    return signal / sensor.electrons_per_level + read + ROUNDING


def sighting_sigmas(T_observer_target: Pose2, cov_observer: np.ndarray) -> np.ndarray:
    """(3,) standard deviations of range (m), bearing, heading (rad) by a (3, 3) covariance in the observer's axes."""
    turn = rotation(-np.arctan2(T_observer_target.y(), T_observer_target.x()))
    along, across = np.sqrt(np.diag(turn @ cov_observer[:2, :2] @ turn.T))
    return np.array([along, across / np.hypot(*position(T_observer_target)), np.sqrt(cov_observer[2, 2])])


def _by_nuisance(window: _Window, radiance, seen, pose: Pose2, settings: RenderSettings) -> np.ndarray:
    """(P, 6) derivatives of the grey levels by what is unknown besides the pose; the scene is linear in its light."""
    light, sensor = settings.light, settings.sensor
    by_ambient = seen(pose, replace(light, ambient=light.ambient + 1)) - radiance
    by_direct = seen(pose, replace(light, direct=light.direct + 1)) - radiance
    surroundings = radiance - light.ambient * by_ambient - light.direct * by_direct
    dark = replace(sensor, black_level=0.0)
    columns = [window.exposed(each, dark) for each in (by_ambient, by_direct, surroundings)]
    columns.append(np.ones_like(columns[0]))  # black level
    for field, step in (("defocus_px", DEFOCUS_STEP_PX), ("motion_px", MOTION_STEP_PX)):
        now = getattr(sensor, field)
        more, less = now + step, max(now - step, 0.0)
        ends = [window.exposed(radiance, replace(sensor, **{field: value})) for value in (more, less)]
        columns.append((ends[0] - ends[1]) / (more - less))
    return np.stack(columns, axis=1)


def _moves(camera: Camera, target: Target, T_observer_target: Pose2) -> np.ndarray | None:
    """(3, 3) rows: changes of x, y, theta along the line of sight, across it, and of the heading alone, each as large
    as moves the fastest point of the marked solid by STEP_PX; None when no point of it has a picture."""
    away = position(T_observer_target) - camera.mount.position_body[:2]
    sight = np.eye(3)
    sight[:2, :2] = rotation(np.arctan2(away[1], away[0])).T
    points = target.solids[0].extent()
    still = _projected(camera, points, T_observer_target)
    speeds = [np.abs(_projected(camera, points, _moved(T_observer_target, PROBE * way)) - still) for way in sight]
    speeds = [speed[np.isfinite(speed)] / PROBE for speed in speeds]
    if not all(speed.size and speed.max() > 0 for speed in speeds):
        return None
    return np.array([STEP_PX / speed.max() * way for speed, way in zip(speeds, sight, strict=True)])


def _projected(camera: Camera, points: np.ndarray, T_observer_target: Pose2) -> np.ndarray:
    floor = points[:, :2] @ rotation(T_observer_target.theta()).T + position(T_observer_target)
    return camera.project(np.column_stack([floor, points[:, 2]]))[0]


def _moved(pose: Pose2, change: np.ndarray) -> Pose2:
    return Pose2(pose.x() + change[0], pose.y() + change[1], pose.theta() + change[2])


def _window(camera: Camera, target: Target, poses: list[Pose2], sensor: Sensor) -> _Window | None:
    """What holds the target at all of the poses; None when it is not in the picture at one of them."""
    boxes = [target_box(camera, target.solids, pose) for pose in poses]
    if any(box is None for box in boxes):
        return None
    reach = int(np.ceil(4 * (sensor.defocus_px + DEFOCUS_STEP_PX) + (sensor.motion_px + MOTION_STEP_PX) / 2)) + 3
    drawn, read = [], []
    for sides, size in zip(zip(*boxes, strict=True), (camera.lens.height_px, camera.lens.width_px), strict=True):
        first, last = min(side.start for side in sides), max(side.stop for side in sides)
        outer = slice(max(first - 2 * reach, 0), min(last + 2 * reach, size))
        drawn.append(outer)
        read.append(slice(max(first - reach, 0) - outer.start, min(last + reach, size) - outer.start))
    shape = camera.lens.height_px, camera.lens.width_px
    flat = Sensor(gain=1.0, black_level=0.0, vignetting=sensor.vignetting, defocus_px=0.0)
    vignette = flat.exposed(np.ones([CELLS * size for size in shape], np.float32))[tuple(drawn)]
    cells = tuple(slice(CELLS * side.start, CELLS * side.stop) for side in drawn)
    return _Window(cells, tuple(read), vignette)
