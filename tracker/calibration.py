"""A camera and its target calibrated together, by pictures of the target at known distances.

Where the ends of the pattern are in the picture tells the range, through the height and tilt of the camera, its focal
length and the target's size (section 2.1 of the paper). These are estimated, as many as are asked for, and with them
bearing and heading of the target in every picture, which need not be known. The nominal data sheet takes part with its
tolerances, so that what the pictures do not tell stays where the sheet has it, and is said.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coopslam.errors import BadInput
from coopslam.se2 import Pose2
from tracker.calibration_edges import Located, Picture, Shifted, View, edges_of
from tracker.calibration_fit import FEWEST_EDGES, Fit, Shot, fit
from tracker.calibration_parameters import require_known, tolerances_of
from tracker.calibration_search import find_target
from tracker.data_sheet import CalibrationNote, DataSheet
from tracker.detector import require_picture

FEWEST_PICTURES = 3
COARSE_ROUNDS = 1  # a shift is measured once, against the nominal sheet
REACH_SHARE = 0.0125  # of the picture's width: how far edges are looked for, 8 of 640 pixels
EXCITED = 0.5  # a direction is measured when its posterior sigma is below this share of the prior one
ALONE = 0.3  # correlation with others below which a parameter is named by itself
NAMED = 0.3  # of a direction: parameters with at least this share of it are named


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """What pictures at known distances say of a data sheet."""

    sheet: DataSheet  # its `calibration` tells sigmas and residuals
    nominal: DataSheet
    names: tuple[str, ...]
    fit: Fit
    shots: tuple[Shot, ...]  # that were used
    located: tuple[Located, ...]  # edges that were found in them
    lost: tuple[str, ...]  # pictures without a target, or with too few clear edges
    weak: tuple[str, ...]  # what is not observable, in words

    @property
    def sigmas(self) -> np.ndarray:
        """(P,) standard deviations of the parameters."""
        return np.sqrt(np.diag(self.fit.cov))


def calibrate_tracker(
    nominal: DataSheet,
    names: Sequence[str],
    shots: Sequence[Shot],
    images: Sequence[np.ndarray],
    tell: Callable[[str], None] = lambda text: None,
) -> Calibrated:
    """Parameters by (H, W) uint8 pictures, each with what is known of it.

    Raises BadInput for a wrong size, or when the target is found in fewer than three pictures.
    """
    names = require_known(nominal, names)
    starts = []
    for shot, image in zip(shots, images, strict=True):
        _require_picture(shot, image, nominal)
        starts.append(find_target(image, nominal, shot.distance_m, shot.bearing_rad, shot.heading_rad))
    lost = [shot.name for shot, start in zip(shots, starts, strict=True) if start is None]
    kept = [k for k, start in enumerate(starts) if start is not None]
    tell(f"target found in {len(kept)} of {len(shots)} pictures")
    if len(kept) < FEWEST_PICTURES:
        raise BadInput(
            f"the target is found in {len(kept)} of {len(shots)} pictures; in at least {FEWEST_PICTURES} expected"
        )
    views = [Picture(images[k]) for k in kept]
    coarse = [Shifted(starts[k].shift_px) for k in kept]
    poses = [starts[k].pose for k in kept]
    return calibrated_by_views(nominal, names, [shots[k] for k in kept], views, poses, coarse, lost, tell)


def calibrated_by_views(
    nominal: DataSheet,
    names: Sequence[str],
    shots: Sequence[Shot],
    views: Sequence[View],
    poses: Sequence[Pose2],
    coarse: Sequence[View] | None = None,
    lost: Sequence[str] = (),
    tell: Callable[[str], None] = lambda text: None,
) -> Calibrated:
    """The same from whatever measures edges, and (n,) poses near the true ones. coarse: views to begin with."""
    reach_px, sheet = REACH_SHARE * nominal.camera.lens.width_px, nominal
    if coarse is not None:
        held = [_held(shot, pose) for shot, pose in zip(shots, poses, strict=True)]
        rough = fit(nominal, _liftable(names), held, coarse, poses, reach_px, rounds=COARSE_ROUNDS, fixed_noise=True)
        sheet, poses = rough.sheet, rough.poses
    clear = [k for k, view in enumerate(views) if _edges_found(sheet, view, poses[k], reach_px) >= FEWEST_EDGES]
    lost = [*lost, *(shot.name for k, shot in enumerate(shots) if k not in clear)]
    if len(clear) < FEWEST_PICTURES:
        raise BadInput(
            f"edges of the target are clear in {len(clear)} pictures; in at least {FEWEST_PICTURES} expected"
        )
    shots, views, poses = ([each[k] for k in clear] for each in (shots, views, poses))
    found = fit(sheet, names, shots, views, poses, reach_px, nominal)
    tell(f"{sum(len(one.offsets) for one in found.measured)} edges, rms {found.residual_rms_px:.3f} px")
    located = tuple(Located.of(one.edges, one.offsets, one.sigmas) for one in found.measured)
    note = _note(names, found, len(shots))
    calibrated = replace(found.sheet, calibration=note)
    weak = weak_directions(nominal, names, found.cov)
    return Calibrated(calibrated, nominal, tuple(names), found, tuple(shots), located, tuple(lost), weak)


def weak_directions(nominal: DataSheet, names: Sequence[str], cov: np.ndarray) -> tuple[str, ...]:
    """In words, what the pictures do not tell: directions in which the nominal tolerances are all that holds.

    cov: (P, P) posterior. Eigenvectors of D^-1 cov D^-1, D the tolerances: an eigenvalue of one has learned nothing.
    """
    tolerances = tolerances_of(nominal, names)
    ratio = cov / np.outer(tolerances, tolerances)
    sizes = np.sqrt(np.diag(ratio))
    others = np.abs(ratio / np.outer(sizes, sizes)) - np.eye(len(names))
    alone = (sizes > EXCITED) & (others.max(axis=1, initial=0.0) < ALONE)
    said = [f"{names[k]}: not observable with these pictures ({_left(sizes[k])})" for k in np.flatnonzero(alone)]
    rest = np.flatnonzero(~alone)
    values, vectors = np.linalg.eigh(ratio[np.ix_(rest, rest)])
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < EXCITED**2:
            break
        together = " and ".join(names[rest[k]] for k in range(len(rest)) if abs(vector[k]) >= NAMED)
        said.append(f"{together}: changed together they leave these pictures as they are ({_left(np.sqrt(value))})")
    return tuple(said)


def _left(share: float) -> str:
    return f"{share:.0%} of the sheet's tolerance is left, which holds it"


def _edges_found(sheet: DataSheet, view: View, pose: Pose2, reach_px: float) -> int:
    return int(np.count_nonzero(view.measure(edges_of(sheet, pose), reach_px)[2]))


def _held(shot: Shot, pose: Pose2) -> Shot:
    """Bearing and heading stay what the search found."""
    bearing = float(np.arctan2(pose.y(), pose.x()))
    return replace(shot, bearing_rad=bearing, heading_rad=pose.theta(), bearing_sigma_rad=0.003, heading_sigma_rad=0.02)


def _liftable(names: Sequence[str]) -> tuple[str, ...]:
    """What a shift up or down can tell; without any of these a wrong tilt is still followed, and given back after."""
    return tuple(name for name in names if name in ("height", "tilt", "cy")) or ("tilt",)


def _note(names: Sequence[str], found: Fit, pictures: int) -> CalibrationNote:
    sigmas = np.sqrt(np.diag(found.cov))
    correlation = found.cov / np.outer(sigmas, sigmas)
    return CalibrationNote(
        pictures,
        found.residual_rms_px,
        dict(zip(names, sigmas.tolist(), strict=True)),
        tuple(tuple(row) for row in correlation.tolist()),
    )


def _require_picture(shot: Shot, image: np.ndarray, sheet: DataSheet) -> None:
    try:
        require_picture(image, sheet.camera.lens)
    except BadInput as error:
        raise BadInput(f"{shot.name}: {error}") from error
