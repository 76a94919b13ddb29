"""Sensors calibrated by the log that they recorded, without truth, while the trajectory is smoothed.

Rounds of two steps: the trajectory is smoothed with the records as they are calibrated so far, by native factors
(Levenberg-Marquardt); then the constants make a Gauss-Newton step in which the trajectory may follow
(`parameter_step`). A few rounds are enough where fits to a fixed trajectory would creep.

How large the world is cannot be known from a log whose every metre comes from sensors of unknown scale: multiply the
world by s, and odometry scale by s and range scale by 1 / s make up for it, while fixed noise rewards a small world. So
the gauge is a hard constraint: the mean scale of odometry equals the mean scale of ranges, each being as likely wrong.
Constants that the log does not excite stay at their defaults: those whose posterior standard deviation, given the
prior, remains above a share of the prior one.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from coopslam.errors import BadInput, require_between, require_positive
from coopslam.estimation import batch
from coopslam.estimation.calibration import PARAMETERS, Calibration, Provenance, RobotCalibration, calibrated
from coopslam.estimation.driven_path import DrivenPath, between, compose, driven_paths, interpolated
from coopslam.estimation.gate import GateSettings
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.estimation.keys import is_landmark, is_vertex, landmark_key, robot_index, value_of
from coopslam.estimation.loss import Loss
from coopslam.estimation.offline import SmoothSettings, require_connected
from coopslam.estimation.parameter_step import COUNT, DEFAULTS, Reduced, best_change, reduced
from coopslam.estimation.replay import in_groups, replay
from coopslam.estimation.sensor_residuals import (
    Course,
    camera_noise,
    looks_like_depth,
    odometry_noise,
    sightings_of,
    sizes,
)
from coopslam.estimation.synchronize import synchronized
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.estimation.tracks import Edge
from coopslam.records import CornerDecision, LandmarkPrior, LoopClosure, PosePrior, Record
from coopslam.se2 import Pose2, xytheta
