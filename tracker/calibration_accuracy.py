"""What a calibration is worth: ranges of pictures that took no part in it, and errors to be expected at any range."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.se2 import Pose2, position
from tracker.calibration import FEWEST_PICTURES, Calibrated
from tracker.calibration_edges import Expected, Located, View
from tracker.calibration_fit import Fit, Shot, fit, measured_edges
from tracker.calibration_noise import BIASES_PX, Noise, class_of, robust_weights, whitened
from tracker.calibration_parameters import tolerances_of, values_of, with_values
from tracker.data_sheet import DataSheet
from tracker.information import sighting_sigmas

ROUNDS = 6
HEADING_SIGMA_RAD = 0.3  # so that the stripes, which may be found late, need not tell it at first
CHANGES = 6  # from the calibrated to the nominal sheet
HEADINGS = 6  # over which expected errors are averaged


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Ranges of a picture that took no part: by the nominal sheet, and by one calibrated with the other pictures."""

    name: str
    distance_m: float
    before_m: float | None  # None: its edges do not fit that sheet
    after_m: float | None
    sigma_m: float | None  # of `after_m`, by edges and calibration


def held_out(calibrated: Calibrated) -> list[HeldOut]:
    """For each picture its range by its edges alone, without a calibration and with one by all the others."""
    if len(calibrated.shots) <= FEWEST_PICTURES:
        return []
    results = []
    for k, (shot, view) in enumerate(zip(calibrated.shots, calibrated.located, strict=True)):
        others = _without(calibrated, k)
        before = _by_nominal(calibrated, k)
        after = measured_pose(others.sheet, view, calibrated.fit.poses[k], calibrated.fit.noise)
        sigma = None
        if after is not None:
            sigmas = expected_sigmas(
                others.sheet, calibrated.names, others.cov, after.poses[0], calibrated.fit.noise, view
            )
            sigma = float(sigmas[1, 0])
        results.append(HeldOut(shot.name, shot.distance_m, _range(before), _range(after), sigma))
    return results


def measured_pose(sheet: DataSheet, view: View, start: Pose2, noise: Noise) -> Fit | None:
    """The pose that a sheet gives to edges that were found; None when they do not fit it at all."""
    shot = Shot("", None, heading_rad=start.theta(), heading_sigma_rad=HEADING_SIGMA_RAD)
    try:
        return fit(sheet, (), [shot], [view], [start], 0.0, noise=noise, rounds=ROUNDS, fixed_noise=True)
    except UnderDetermined:
        return None


def expected_curve(calibrated: Calibrated, ranges_m: Sequence[float]) -> np.ndarray:
    """(R, 2, 3) sigmas of range (m), bearing and heading (rad) straight ahead: by the noise of edges in one picture,
    and with the uncertainty of the calibration. NaN where too little of the target is in view.

    Edges are as noisy as those of the calibration's pictures at about that distance.
    """
    yaw = calibrated.sheet.camera.mount.yaw_rad
    order = np.argsort([shot.distance_m for shot in calibrated.shots])
    distances = np.array([calibrated.shots[k].distance_m for k in order])
    noises = np.array([np.median(calibrated.located[k].sigmas_px) for k in order])
    curve = []
    for range_m in ranges_m:
        view = Expected(float(np.interp(range_m, distances, noises)))
        squares = []
        for heading in np.arange(HEADINGS) * (2 * np.pi / HEADINGS):
            pose = Pose2(range_m * np.cos(yaw), range_m * np.sin(yaw), heading + 0.2)
            try:
                sigmas = expected_sigmas(
                    calibrated.sheet, calibrated.names, calibrated.fit.cov, pose, calibrated.fit.noise, view
                )
            except UnderDetermined:
                sigmas = np.full((2, 3), np.nan)
            squares.append(sigmas**2)
        curve.append(np.sqrt(np.mean(squares, axis=0)))
    return np.array(curve)


def expected_sigmas(
    sheet: DataSheet, names: Sequence[str], cov: np.ndarray, pose: Pose2, noise: Noise, view: View
) -> np.ndarray:
    """(2, 3) sigmas of range (m), bearing, heading (rad) of one picture: edges alone, and with the calibration's.

    cov: (P, P) of the parameters p. With J_x, J_p the derivatives of the edges' places by pose (and biases of edges)
    and by parameters, and W their information, the pose is wrong by -(J_x' W J_x)^-1 J_x' W J_p dp when the parameters
    are wrong by dp.
    Raises UnderDetermined when too little is in view.
    """
    (one,) = measured_edges(sheet, names, tolerances_of(sheet, names), [Shot("", None)], [view], [pose], 0.0)
    one = replace(one, offsets=np.zeros(len(one.offsets)))
    J, _, _ = whitened(one, robust_weights(one, one.offsets), noise)
    by_parameters, by_others = J[:, : len(names)], J[:, len(names) :]
    biases = np.concatenate([[BIASES_PX[class_of(label)] ** -2.0 for label in one.labels], np.zeros(3)])
    information = by_others.T @ by_others + np.diag(biases)
    if np.linalg.cond(information) > 1e12:
        raise UnderDetermined("the pose of the target is not tied down by its edges")
    inverse = np.linalg.inv(information)[-3:]
    alone, follows = inverse[:, -3:], inverse @ by_others.T @ by_parameters
    return np.array([sighting_sigmas(pose, each) for each in (alone, alone + follows @ cov @ follows.T)])


def _by_nominal(calibrated: Calibrated, k: int) -> Fit | None:
    """The pose by the nominal sheet, reached in small changes of the calibrated one, since they may be metres apart."""
    found, start = None, calibrated.fit.poses[k]
    nominal = values_of(calibrated.nominal, calibrated.names)
    for share in np.linspace(0.0, 1.0, CHANGES + 1)[1:]:
        values = (1 - share) * calibrated.fit.values + share * nominal
        sheet = with_values(calibrated.nominal, calibrated.names, values)
        found = measured_pose(sheet, calibrated.located[k], start, calibrated.fit.noise)
        if found is None:
            return None
        start = found.poses[0]
    return found


def _without(calibrated: Calibrated, k: int) -> Fit:
    """The calibration by all pictures but one, from edges where they were found."""
    others = [j for j in range(len(calibrated.shots)) if j != k]
    located: list[Located] = [calibrated.located[j] for j in others]
    return fit(
        calibrated.sheet,
        calibrated.names,
        [calibrated.shots[j] for j in others],
        located,
        [calibrated.fit.poses[j] for j in others],
        0.0,
        calibrated.nominal,
        calibrated.fit.noise,
        ROUNDS,
        fixed_noise=True,
    )


def _range(found: Fit | None) -> float | None:
    return None if found is None else float(np.hypot(*position(found.poses[0])))
