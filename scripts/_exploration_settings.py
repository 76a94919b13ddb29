"""Every setting of a simulated exploration."""

from dataclasses import dataclass, field, fields, replace
from typing import Literal

from coopslam.errors import BadInput, shown
from coopslam.estimation.batch import Batch
from coopslam.estimation.dead_reckoning import DeadReckoning
from coopslam.estimation.ekf import Ekf, EkfSettings
from coopslam.estimation.fixed_lag import FixedLag, FixedLagSettings
from coopslam.estimation.gate import GateSettings
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.estimation.robust import RobustSettings
from coopslam.estimation.weighted import Weighted
from coopslam.exploration.explorer import ExplorerSettings
from coopslam.exploration.mission import Budget
from coopslam.io.toml import to_mapping
from sim.noise import PRESETS, TRACKERS, FalseSightings, Noise, OdometryBias, TrackerLimits, preset
from sim.team import TeamSettings
from sim.vision_settings import VisionSettings, limits_m
from tracker.data_sheet import DataSheet

DRIVERS = {
    "incremental": Incremental,
    "fixed-lag": FixedLag,
    "ekf": Ekf,
    "weighted": Weighted,
    "dead-reckoning": DeadReckoning,
    "batch": Batch,
}
CAMERAS = ("helix", "apriltag")  # trackers that take pictures
LARGEST_SEED = 2**63 - 1  # that TOML promises to carry


@dataclass(frozen=True, slots=True)
class ExplorationSettings:
    """Every setting of a simulated exploration; the keys of a config file."""

    world: str = "paper_one_obstacle"
    seed: int = 0
    noise: Literal["none", "typical", "legged"] = "typical"
    tracker: Literal["statistical", "helix", "apriltag"] = "statistical"  # the others: pictures, rendered and searched
    tracker_preset: Literal["helix", "retroreflector", "laser-stripe"] = "helix"  # of the statistical one
    estimator: Literal["incremental", "fixed-lag", "ekf", "weighted", "dead-reckoning", "batch"] = "incremental"
    figures: Literal["none", "static", "all"] = "static"
    resume_map: str = ""  # directory of a run whose map this one extends; empty: begin anew
    true_noise: Noise | None = None  # instead of the preset's
    believed_noise: Noise | None = None
    tracker_limits: TrackerLimits | None = None  # instead of the preset's, or of those of camera and target
    vision: VisionSettings = field(default_factory=VisionSettings)
    bias: OdometryBias = field(default_factory=OdometryBias)
    false_sightings: FalseSightings = field(default_factory=FalseSightings)
    team: TeamSettings = field(default_factory=TeamSettings)
    explorer: ExplorerSettings = field(default_factory=ExplorerSettings)
    incremental: IncrementalSettings = field(default_factory=IncrementalSettings)
    fixed_lag: FixedLagSettings = field(default_factory=FixedLagSettings)
    ekf: EkfSettings = field(default_factory=EkfSettings)  # also of weighted
    gate: GateSettings = field(default_factory=GateSettings)  # for false sightings, while the robots drive
    robust: RobustSettings = field(default_factory=RobustSettings)  # for false sightings, in the final smoothing
    budget: Budget = field(default_factory=Budget)

    def __post_init__(self):
        if not 0 <= self.seed <= LARGEST_SEED:
            raise BadInput(f"seed: zero or more expected, at most 2^63 - 1, got {shown(self.seed)}")
        if self.tracker != "statistical" and self.tracker_preset != "helix":
            raise BadInput(f"tracker_preset: helix expected for the tracker {self.tracker}, got {self.tracker_preset}")

    def resolved(self) -> "ExplorationSettings":
        """The same with noise and limits spelled out. Raises BadInput when a belief leaves no room for doubt."""
        true, believed = preset(self.noise, self.tracker_preset)
        true, believed = self.true_noise or true, self.believed_noise or believed
        limits = self.tracker_limits or self._limits()
        for part in fields(believed):
            for key, sigma in to_mapping(getattr(believed, part.name)).items():
                if not sigma > 0:
                    raise BadInput(f"believed_noise.{part.name}.{key}: more than zero expected, got {sigma}")
        return replace(self, true_noise=true, believed_noise=believed, tracker_limits=limits)

    def sheet(self) -> DataSheet:
        """The data sheet of a tracker with a camera. Raises BadInput that begins with the dotted key."""
        try:
            return self.vision.load(self.tracker)
        except BadInput as error:
            raise BadInput(f"vision.{self.tracker}_sheet: {error}") from error

    def _limits(self) -> TrackerLimits:
        if self.tracker == "statistical":
            return TRACKERS[self.tracker_preset][1]
        sheet = self.sheet()
        try:
            nearest_m, farthest_m = limits_m(sheet, self.vision)
        except BadInput as error:
            raise BadInput(f"vision.{error}") from error
        return TrackerLimits(farthest_m, min_range_m=nearest_m)

    def with_eyes(self, tracker: str) -> "ExplorationSettings":
        """The same with another kind of tracker, within its own limits."""
        return replace(self, tracker=tracker, tracker_limits=None)

    def with_sheet(self, sheet: str) -> "ExplorationSettings":
        """The same with another camera and target."""
        return replace(self, vision=replace(self.vision, **{f"{self.tracker}_sheet": sheet}), tracker_limits=None)

    def with_tracker(self, name: str) -> "ExplorationSettings":
        """The same with another preset of the robot tracker, also where the noise is spelled out."""
        sigmas, limits = TRACKERS[name]
        limits = limits if self.tracker == "statistical" else None
        noise = {key: getattr(self, key) for key in ("true_noise", "believed_noise")}
        noise = {key: replace(law, tracker=sigmas) for key, law in noise.items() if law is not None}
        return replace(self, tracker_preset=name, tracker_limits=limits, **noise)

    @property
    def noise_name(self) -> str:
        """The preset that the noise in force equals, or "custom"."""
        true, believed = preset(self.noise, self.tracker_preset)
        in_force = (self.true_noise or true, self.believed_noise or believed)
        return next((name for name in PRESETS if preset(name, self.tracker_preset) == in_force), "custom")
