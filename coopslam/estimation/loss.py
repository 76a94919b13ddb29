"""Robust losses for sightings that may be false and come with the covariance of good ones."""

from dataclasses import dataclass
from typing import Literal, get_args

import gtsam

from coopslam.errors import BadInput, require_positive, shown

Kind = Literal["squares", "huber", "cauchy"]
KINDS = get_args(Kind)
_CONSTANTS = {"huber": 1.345, "cauchy": 2.385}  # 95 % efficiency for normal errors (Holland and Welsch 1977)


@dataclass(frozen=True, slots=True)
class Loss:
    """What a residual costs: its square, or less than that where it is large."""

    kind: Kind = "squares"
    scale_sigmas: float = 1.0  # a factor on the constant of 95 % efficiency: 1.345 sigma (Huber), 2.385 sigma (Cauchy)

    def __post_init__(self):
        if self.kind not in KINDS:
            raise BadInput(f"kind: one of {', '.join(KINDS)} expected, got {shown(self.kind)}")
        require_positive(scale_sigmas=self.scale_sigmas)

    def applied(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """The noise model with this loss."""
        if self.kind == "squares":
            return noise
        kind = {"huber": gtsam.noiseModel.mEstimator.Huber, "cauchy": gtsam.noiseModel.mEstimator.Cauchy}[self.kind]
        return gtsam.noiseModel.Robust.Create(kind.Create(_CONSTANTS[self.kind] * self.scale_sigmas), noise)


SQUARES = Loss()
