"""Finds a robot by the AprilTags of its cube: aruco reads the tags, a fit of all their pixels measures the pose.

A single tag seen from the front leaves two headings, mirrored about the line of sight. Both are tried; where the
picture does not tell them apart, the heading is withheld and the position's covariance covers both.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from coopslam.errors import require_positive
from coopslam.se2 import Pose2, rotation, wrap
from tracker.camera import Camera
from tracker.detector import Detection, require_picture
from tracker.lens import Lens
from tracker.tag_corners import Tag, corner_minima
from tracker.tag_cube import FAMILY, SIDES, TagCube
from tracker.tag_fit import SMALL_PX, TagFit, fit_tags
from tracker.tag_region import Region, region_of


@dataclass(frozen=True, slots=True)
class TagDetectorSettings:
    """When a detection is believed. Raises BadInput naming the field."""

    corner_error_max_px: float = 5.0  # root mean square of aruco's corners against one pose; its refinement may slip
    explained_min: float = 0.85  # share of the picture's variance on a tag that the prediction must explain
    contrast_min: float = 8.0  # grey levels between light and dark
    corner_sigma_px: float = 0.5  # of aruco's corners: which minima of theirs are tried
    corner_distance_sq_max: float = 60.0  # beyond the best minimum
    distance_sq_min: float = 20.0  # by so much chi-square another heading must be worse; odds of exp(10) to one
    heading_sigma_max_rad: float = 0.3  # a heading that is known less well is none

    def __post_init__(self):
        for name in self.__slots__:
            require_positive(**{name: getattr(self, name)})


class TagDetector:
    """Detector of tag cubes in the pictures of one camera."""

    def __init__(self, camera: Camera, cube: TagCube, settings: TagDetectorSettings | None = None):
        self.camera, self.cube, self.settings = camera, cube, settings or TagDetectorSettings()
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(FAMILY), parameters)
        self._rays = _pixel_centres(camera.lens)

    def detect(self, image: np.ndarray) -> Detection | None:
        """The robot in a (H, W) uint8 picture, None without any. Raises BadInput for another size or type."""
        require_picture(image, self.camera.lens)
        tags = self._tags(image)
        choices = [tags, *([tag] for tag in tags)] if len(tags) > 1 else [tags]  # one of several may be another's
        for chosen in choices:
            detection = self._measured(image, chosen) if chosen else None
            if detection is not None:
                return detection
        return None

    def _tags(self, image: np.ndarray) -> list[Tag]:
        """The cube's own tags in the picture, the largest first, none of them twice."""
        corners, ids, _ = self._aruco.detectMarkers(np.ascontiguousarray(image))
        found: dict[int, Tag] = {}
        known = [] if ids is None else zip(ids.ravel().tolist(), corners, strict=True)
        for tag, four in sorted(known, key=lambda item: -cv2.contourArea(item[1])):
            if tag in self.cube.ids and tag not in found:
                pixels = four.reshape(4, 2).astype(float)
                found[tag] = Tag(self.cube.ids.index(tag), pixels, self.camera.lens.normalised(pixels))
        return list(found.values())

    def _measured(self, image: np.ndarray, tags: list[Tag]) -> Detection | None:
        """The pose by some tags; None when they are not where a cube on the floor can show them."""
        limits = self.settings
        minima = corner_minima(self.camera, self.cube, tags)
        if not minima or minima[0].cost_px > 4 * len(tags) * limits.corner_error_max_px**2:
            return None
        regions = [region_of(image, self.camera, self.cube, tag, self._rays) for tag in tags]
        regions = [region for region in regions if region is not None]
        near = minima[0].cost_px + limits.corner_distance_sq_max * limits.corner_sigma_px**2
        starts = [fit.pose for fit in minima if fit.cost_px <= near]
        fits = self._fits(regions, starts, tags) if regions else []
        if not fits or fits[0].explained < limits.explained_min or fits[0].contrast < limits.contrast_min:
            return None
        return self._detection(fits, tags)

    def _fits(self, regions: list[Region], starts: list[np.ndarray], tags: list[Tag]) -> list[TagFit]:
        """All minima of the photometric error that matter, the best first."""
        first = fit_tags(regions, self.camera, starts[0])
        if first is None:
            return []
        if len(tags) == 1 and tags[0].face < SIDES and regions[0].module_px < SMALL_PX:
            starts = [*starts, self._mirrored(first.pose, tags[0].face)]
        found = [first]
        if len(starts) > 1:  # all with the same noise of the pixels
            found = [fit_tags(regions, self.camera, first.pose, first.noise) or first]
        for start in starts[1:]:
            fit = fit_tags(regions, self.camera, start, first.noise)
            if fit is not None and all(abs(wrap(fit.pose[2] - other.pose[2])) > 0.01 for other in found):
                found.append(fit)
        return sorted(found, key=lambda fit: fit.chi_square)

    def _mirrored(self, pose: np.ndarray, face: int) -> np.ndarray:
        """The pose with the heading mirrored about the line of sight to a side face, whose middle stays."""
        axes = self.cube.face_axes(face)
        middle = (self.cube.centre_body + self.cube.face_m / 2 * axes[2])[:2]
        seen = pose[:2] + rotation(pose[2]) @ middle
        back = self.camera.mount.position_body[:2] - seen
        out = pose[2] + np.arctan2(axes[2][1], axes[2][0])
        heading = wrap(pose[2] + 2 * wrap(np.arctan2(back[1], back[0]) - out))
        return np.array([*(seen - rotation(heading) @ middle), heading])

    def _detection(self, fits: list[TagFit], tags: list[Tag]) -> Detection:
        """One pose; with an open heading the mean of all that remain, equally likely, and the covariance over them.

        The difference that is too small to decide is too small for odds as well: it rests on how pixels blur.
        """
        best, limits = fits[0], self.settings
        worse = np.array([(fit.chi_square - best.chi_square) / best.scale for fit in fits])
        remaining = [fit for fit, distance in zip(fits, worse, strict=True) if distance < limits.distance_sq_min]
        features = tuple(np.vstack([tag.corners_px, tag.corners_px[:1]]) for tag in tags)
        if len(remaining) == 1:
            known = bool(best.cov[2, 2] <= limits.heading_sigma_max_rad**2)
            return Detection(Pose2(*best.pose), _symmetric(best.cov), known, features)
        poses = np.array([fit.pose for fit in remaining])
        poses[:, 2] = best.pose[2] + wrap(poses[:, 2] - best.pose[2])
        mean, apart = poses.mean(axis=0), poses - poses.mean(axis=0)
        cov = (sum(fit.cov for fit in remaining) + apart.T @ apart) / len(remaining)
        return Detection(Pose2(*mean), _symmetric(cov), False, features)


def _symmetric(cov: np.ndarray) -> np.ndarray:
    return (cov + cov.T) / 2


@lru_cache(maxsize=4)
def _pixel_centres(lens: Lens) -> np.ndarray:
    """(H, W, 2) normalised points of the centres of all pixels."""
    u, v = np.meshgrid(np.arange(lens.width_px, dtype=float), np.arange(lens.height_px, dtype=float))
    rays = lens.normalised(np.stack([u, v], axis=-1))
    rays.setflags(write=False)
    return rays
