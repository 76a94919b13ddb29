"""Sensors calibrated by the log that they recorded, without truth, in turns with the smoothing of the trajectory.

Rounds of two steps: the trajectory is smoothed with the records as they are calibrated so far, by native factors and
Levenberg-Marquardt, from where the round before left it; then the constants of the sensors make a Gauss-Newton step in
which the trajectory may follow (`parameter_step`), so that three rounds do where fits to a fixed one would creep.

How large the world is cannot be known from a log whose every metre comes from sensors of unknown scale: multiply the
world and the scale of odometry by s, divide the scale of ranges by s, and everything fits as before, while noise of a
fixed size rewards a small world. So the gauge is a hard constraint: the mean scale of odometry equals the mean scale of
ranges, each being as likely to be wrong. Where surveys or loop closures measure the world there is no such constraint.

A constant that is known to be right can be held at its default; a scale that is held tells how large the world is.

Constants that the log does not excite stay at their defaults: those whose posterior standard deviation remains above a
share of the prior one. The noise of sightings is never read off the solved trajectory, which bends to them; a size that
is fed back becomes smaller in each round.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace

import gtsam
import numpy as np

from coopslam.errors import BadInput, require_between, require_positive, shown
from coopslam.estimation import batch
from coopslam.estimation.batch import BatchEstimate
from coopslam.estimation.calibration import PARAMETERS, Calibration, CameraNoise, Provenance, RobotCalibration
from coopslam.estimation.calibration import calibrated as set_right
from coopslam.estimation.driven_path import driven_paths
from coopslam.estimation.incremental import Incremental
from coopslam.estimation.loss import Loss
from coopslam.estimation.offline import SmoothSettings, require_connected
from coopslam.estimation.ordering import nested_dissection
from coopslam.estimation.parameter_step import DEFAULTS, best_change, reduced
from coopslam.estimation.rebuilt_graph import Rebuilt, Solution, rebuilt
from coopslam.estimation.replay import Replay, in_groups, replay
from coopslam.estimation.robust import solve_robust
from coopslam.estimation.sensor_residuals import looks_like_depth, odometry_noise, sightings_of, sizes
from coopslam.estimation.synchronize import synchronized
from coopslam.estimation.timeline import TimelineSettings
from coopslam.records import LandmarkPrior, LoopClosure, PosePrior, Record

CALIBRATED_CAMERA = CameraNoise(0.02, 0.003, 0.01)  # of the robots of MR.CLAM, whose files do not tell it
_ROUGH = 1e-2  # relative decrease of the cost at which the smoothing within a round ends


@dataclass(frozen=True, slots=True)
class PriorSigmas:
    """What is known of a robot's constants before: their standard deviations about the defaults."""

    range_offset_m: float = 0.1
    range_scale: float = 0.1
    bearing_offset_rad: float = 0.1
    odometry_scale: float = 0.1
    turn_scale: float = 0.1
    creep_m_per_rad: float = 0.1
    drift_rad_per_m: float = 0.1
    delay_s: float = 0.3
    heading_offset_rad: float = 0.1

    def __post_init__(self):
        require_positive(1e3, **{name: getattr(self, name) for name in PARAMETERS})


@dataclass(frozen=True, slots=True)
class SelfCalibrationSettings:
    """How a log calibrates its own sensors."""

    rounds: int = 3
    prior: PriorSigmas = field(default_factory=PriorSigmas)
    excited: float = 0.5  # a constant counts as measured when its posterior sigma is below this share of the prior one
    camera: CameraNoise | None = None  # noise of calibrated sightings; None: as the records say
    reads_odometry_noise: bool = False  # from windows of the solved trajectory, after the first round
    smooth: SmoothSettings = field(default_factory=SmoothSettings)
    hold: tuple[str, ...] = ()  # constants that are known to be right, of all robots

    def __post_init__(self):
        require_between(1, 100, rounds=self.rounds)
        for name in self.hold:
            if name not in PARAMETERS:
                raise BadInput(f"hold: {shown(name)}: expected some of {', '.join(PARAMETERS)}")
        require_between(0.0, 1.0, excited=self.excited)


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibrated:
    """What a log says of its sensors, and the trajectory that goes with it."""

    calibration: Calibration
    solution: Solution
    seconds: float
    not_told: tuple[str, ...] = ()  # by the log, in words


def self_calibrate(
    records: Iterable[Record],
    robots: Sequence[str],
    landmarks: Sequence[str] = (),
    timeline: TimelineSettings | None = None,
    settings: SelfCalibrationSettings | None = None,
    log: str = "",
    tell: Callable[[str], None] = lambda text: None,
) -> SelfCalibrated:
    """Constants of all robots from raw records, not yet synchronized.

    timeline: its loss is not used: while it calibrates, all sightings have Cauchy's.  log: a name, for the provenance.
    tell: is told, in words, what has been done.
    Raises BadInput when there are no records, UnderDetermined when nothing ties a robot down.
    """
    began, settings, records = time.perf_counter(), settings or SelfCalibrationSettings(), list(records)
    if not records:
        raise BadInput(f"{log or 'the log'}: no records to calibrate from")
    timeline = replace(_with_legs(timeline or TimelineSettings(), records), loss=Loss("cauchy"))
    paths, end_s = driven_paths(records), max(record.stamp_s for record in records)
    solution = _start(synchronized(records), robots, landmarks, timeline, settings.smooth)
    tell(f"start found, {time.perf_counter() - began:.1f} s")
    is_depth = looks_like_depth(solution.sightings(records))
    constants = np.tile(DEFAULTS, (len(robots), 1))
    calibration = _calibration(constants, robots, is_depth, settings.camera)
    knows_scale = _knows_scale(records) or bool({"odometry_scale", "range_scale"} & set(settings.hold))
    for number in range(settings.rounds):
        ready = synchronized(set_right(records, calibration))
        found = rebuilt(ready, robots, landmarks, timeline, solution, robust_fixes=True)
        values = _relaxed(found)
        step = reduced(
            found.graph, values, found.legs, found.timeline.stamps, [paths.get(robot) for robot in robots], constants
        )
        change, sigmas = _excited_change(step, constants, settings, knows_scale)
        constants = constants + change
        solution = Solution.of(found.timeline, step.moved(values, change.ravel()), end_s)
        odometry = calibration.odometry
        calibration = _calibration(constants, robots, is_depth, settings.camera, odometry)
        if settings.reads_odometry_noise and number == 0:
            odometry = odometry_noise(paths, solution.courses, calibration)
            calibration = replace(calibration, odometry=odometry)
        tell(f"round {number + 1} of {settings.rounds}, {time.perf_counter() - began:.1f} s")
    sightings = sightings_of(records, solution.courses, solution.landmarks)
    provenance = Provenance(
        log,
        sigmas={
            robot: dict(zip(PARAMETERS, own.tolist(), strict=True)) for robot, own in zip(robots, sigmas, strict=True)
        },
        residuals_before=sizes(sightings, paths, solution.courses, Calibration({})),
        residuals_after=sizes(sightings, paths, solution.courses, calibration),
    )
    done = replace(calibration, provenance=provenance)
    words = _not_told(robots, sigmas, settings, knows_scale)
    return SelfCalibrated(done, solution, time.perf_counter() - began, words)


def smooth_calibrated(
    records: Iterable[Record],
    robots: Sequence[str],
    landmarks: Sequence[str],
    timeline: TimelineSettings,
    settings: SmoothSettings,
    solution: Solution,
) -> Replay:
    """Calibrated and synchronized records smoothed to the end, from the trajectory of `self_calibrate`."""
    began, records = time.perf_counter(), list(records)
    found = rebuilt(records, robots, landmarks, _with_legs(timeline, records), solution)
    solved = solve_robust(found.graph, found.timeline.refused, found.values, robots, settings.robust)
    estimate = BatchEstimate(found.timeline, solved.graph, solved.values)
    end_s, seconds = records[-1].stamp_s, time.perf_counter() - began
    count = len(found.timeline.stamps)
    return Replay(estimate, solved.graph, np.array([end_s]), np.array([seconds]), np.array([count]))


def _start(
    records: Sequence[Record],
    robots: Sequence[str],
    landmarks: Sequence[str],
    timeline: TimelineSettings,
    settings: SmoothSettings,
) -> Solution:
    """What a causal smoother makes of raw, synchronized records."""
    causal = Incremental(robots, landmarks, settings.start, settings.gate, timeline)
    replay(causal, in_groups(records, settings.start_period_s))
    require_connected(causal.timeline)
    return Solution.of(causal.timeline, causal.values(), records[-1].stamp_s)


def _relaxed(found: Rebuilt) -> gtsam.Values:
    """Values near the minimum of the graph."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(nested_dissection(found.graph))
    parameters.setRelativeErrorTol(_ROUGH)
    try:
        return gtsam.LevenbergMarquardtOptimizer(found.graph, found.values, parameters).optimize()
    except RuntimeError:  # Cholesky takes a sigma 4 096 times another for an open direction; this goes on with QR
        return batch.optimize(found.graph, found.values)


def _excited_change(
    step, constants: np.ndarray, settings: SelfCalibrationSettings, knows_scale: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Change of the (robots, 9) constants that the log excites, the others going to their defaults, and sigmas."""
    prior = np.array(astuple(settings.prior))
    free = np.tile([name not in settings.hold for name in PARAMETERS], (len(constants), 1))
    _, sigmas = best_change(step, constants, prior, free, knows_scale)
    excited = free & (sigmas < settings.excited * prior)
    change, sigmas = best_change(step, constants, prior, excited, knows_scale)
    return change, np.where(free, sigmas, 0.0)


def _not_told(
    robots: Sequence[str], sigmas: np.ndarray, settings: SelfCalibrationSettings, knows_scale: bool
) -> tuple[str, ...]:
    """In words, what the log leaves open. sigmas: (robots, 9)."""
    said = []
    for robot, own in zip(robots, sigmas, strict=True):
        open_ = [
            name for name, sigma, prior in zip(PARAMETERS, own, astuple(settings.prior), strict=True) if sigma == prior
        ]
        if open_:
            said.append(f"{robot}: {', '.join(open_)}: not observable in this log, kept at the default")
    scales = [PARAMETERS.index("range_scale"), PARAMETERS.index("odometry_scale")]
    if not knows_scale and (sigmas[:, scales] < np.array(astuple(settings.prior))[scales]).any(axis=0).all():
        said.append(
            "size of the world: not observable in this log; only the product of range_scale and odometry_scale is, and "
            "their means are held equal (hold one of the two that is known to be right, or survey two places)"
        )
    elif not knows_scale:
        said.append("size of the world: nothing in this log measures it")
    return tuple(said)


def _with_legs(settings: TimelineSettings, records: Iterable[Record]) -> TimelineSettings:
    """Loop closures name poses of long ago: then each leg of odometry ends with a variable."""
    closures = any(isinstance(record, LoopClosure) for record in records)
    return replace(settings, every_leg=True) if closures else settings


def _knows_scale(records: Iterable[Record]) -> bool:
    """Whether something else than odometry and sightings measures the world.

    Corners do not: robots stand in those that they sight.
    """
    surveyed = 0
    for record in records:
        if isinstance(record, LoopClosure):
            return True
        surveyed += isinstance(record, PosePrior | LandmarkPrior)
    return surveyed > 1


def _calibration(constants: np.ndarray, robots: Sequence[str], is_depth: bool, camera, odometry=None) -> Calibration:
    each: Mapping = {robot: RobotCalibration(*own) for robot, own in zip(robots, constants.tolist(), strict=True)}
    return Calibration(dict(each), is_depth, camera, odometry)
