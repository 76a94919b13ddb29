"""Edges of a helix target: where they should be in a picture, and where they are.

Three kinds. Rings: where a dark ring meets a light collar, arcs at known heights (the inner ends of the rings meet
the helix and are edges only in part; they are left out). Stripes: the edges of the helix between the rings, on some
generators. Silhouettes: the two generators at which the line of sight touches the cylinder; what is behind them is
unknown, so either side may be the darker one.

The model is projected and short profiles are sampled across its edges (Harris 1990, "Tracking with rigid models"). A
profile is fitted with a smeared step, which gives the offset to a fraction of a pixel, and its variance by the
profile's own noise.
"""

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np

from coopslam.se2 import Pose2, position
from tracker.camera import Camera
from tracker.helix import Helix
from tracker.smear import smeared_step

RING_POINTS = 24  # of each ring's edge
GENERATORS = 24  # on which stripes are sampled
SILHOUETTE_POINTS = 24  # of each of the two
VISIBLE = 0.95  # sine of the angle from the facing generator up to which rings and stripes are sampled
SAMPLES_PER_PX = 2  # of a profile
NEAR_PX = 4.0  # of an edge: what is fitted
ROOM_SHARE = 0.7  # of the way to the next edge that is fitted
STEPS = 5  # of Gauss-Newton
BLUR_PX, BLUR_SIGMA = 0.9, 0.5  # of an edge, and the sigma of its logarithm, before it is seen
LEAST_GREY_SIGMA = 0.3  # of a sample: rounding, 1 / sqrt(12)
INTERPOLATED = 4 / 9  # variance that bilinear interpolation leaves of a pixel's, on average over where it is: (2/3)^2
STEP_SIGMAS = 6.0  # a step that is lower than so many sigmas of the noise is none


class Kind(IntEnum):
    """Of an edge."""

    RING = 0
    STRIPE = 1
    SILHOUETTE = 2


@dataclass(frozen=True, slots=True, eq=False)
class ModelEdges:
    """Points on the edges that a camera should see, N in all. Take some of them with `edges.where(mask)`."""

    names: np.ndarray  # (N,) integers: the same point of the target has the same name at another pose or camera
    points_body: np.ndarray  # (N, 3) in the observer's body
    pixels: np.ndarray  # (N, 2)
    normals: np.ndarray  # (N, 2) unit vectors across the edge: to its light side; at silhouettes outwards
    by_pose: np.ndarray  # (N, 3) how far along its normal an edge moves (pixels) per x, y (m), theta (rad)
    room_px: np.ndarray  # (N,) to the next edge of the target along the normal, the nearer one
    kind: np.ndarray  # (N,) of Kind
    signed: np.ndarray  # (N,) whether the light side is known: not at silhouettes

    def where(self, mask: np.ndarray) -> "ModelEdges":
        """Some of them; mask: (N,) bool or (M,) indices."""
        return ModelEdges(*(getattr(self, field)[mask] for field in self.__slots__))


def model_edges(camera: Camera, helix: Helix, T: Pose2) -> ModelEdges:
    """Edges in view when the target is at the pose T in the observer's body; N may be zero.

    Points near the border and in front of the camera are included as long as they are in the picture. Occlusion by
    the rest of the robot is not looked at.
    """
    axis = position(T) + helix.forward_m * np.array([np.cos(T.theta()), np.sin(T.theta())])
    away = camera.mount.position_body[:2] - axis
    apart_m = float(np.hypot(*away))
    if apart_m <= helix.radius_m:
        return _nothing()
    facing, limb = np.arctan2(away[1], away[0]), np.arccos(helix.radius_m / apart_m)
    parts = [_rings(helix, facing), _stripes(helix, facing, T.theta()), _silhouettes(helix, facing, limb)]
    names, azimuths, heights, slopes, lights, gaps, kinds = (np.concatenate(each) for each in zip(*parts, strict=True))
    shown = np.abs(azimuths - facing) <= limb * (1 + 1e-9)
    names, azimuths, heights, slopes, lights, gaps, kinds = (
        each[shown] for each in (names, azimuths, heights, slopes, lights, gaps, kinds)
    )
    c, s = np.cos(azimuths), np.sin(azimuths)
    points = np.column_stack([axis[0] + helix.radius_m * c, axis[1] + helix.radius_m * s, heights])
    pixels, by_point = projected(camera, points)
    at_limb = kinds == Kind.SILHOUETTE
    around = np.column_stack([-helix.radius_m * s, helix.radius_m * c, slopes])
    tangents = np.where(at_limb[:, None], [0.0, 0.0, 1.0], around)
    along = np.einsum("nij,nj->ni", by_point, tangents)
    normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    outwards = np.column_stack([c, s, np.zeros_like(c)])
    lightwards = np.where(at_limb[:, None], outwards, lights[:, None] * np.array([0.0, 0.0, 1.0]))
    towards = np.einsum("nij,nj->ni", by_point, lightwards)
    normals *= np.where(np.sum(towards * normals, axis=1) < 0, -1.0, 1.0)[:, None]
    moved = np.zeros((len(points), 3, 3))
    moved[:, 0, 0] = moved[:, 1, 1] = 1.0
    moved[:, 0, 2], moved[:, 1, 2] = T.y() - points[:, 1], points[:, 0] - T.x()
    across = np.einsum("ni,nij->nj", normals, by_point)
    by_pose = np.einsum("nj,njk->nk", across, moved)
    reach = np.where(at_limb[:, None], helix.radius_m * outwards, [0.0, 0.0, 1.0] * gaps[:, None])
    room = np.abs(np.sum(across * reach, axis=1))
    every = ModelEdges(names, points, pixels, normals, by_pose, room, kinds, ~at_limb)
    ahead = np.isfinite(pixels).all(axis=1)
    return every.where(ahead & camera.lens.contains(np.where(ahead[:, None], pixels, -1.0)))


def projected(camera: Camera, points_body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) pixels of (N, 3) points in the observer's body; (N, 2, 3) their derivative by the points. NaN as there."""
    pixels, _ = camera.project(points_body)
    R = camera.mount.R_body_camera
    in_camera = (points_body - camera.mount.position_body) @ R
    in_camera[:, 2] = np.where(np.isfinite(pixels[:, 0]), in_camera[:, 2], 1.0)
    if not len(pixels):
        return pixels, np.zeros((0, 2, 3))
    zero = np.zeros(3)
    _, jacobian = cv2.projectPoints(in_camera, zero, zero, camera.lens.matrix, camera.lens.distortion)
    by_point = jacobian[:, 3:6].reshape(-1, 2, 3) @ R.T  # by the translation, which is by the point in camera axes
    return pixels, np.where(np.isfinite(pixels)[:, :, None], by_point, np.nan)


def measure(image: np.ndarray, edges: ModelEdges, reach_px: float = 6.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the edges are: (N,) offsets along their normals and (N,) sigmas in pixels, (N,) whether they were found.

    image: (H, W) uint8.  reach_px: an edge that is farther from its place is not found; there should be no other edge
    of the target so near (see room_px: the search stops halfway to it).  Without the edge, offset and sigma are NaN.
    Points whose profiles overlap (nearer than a pixel or two) share their noise.
    """
    offsets, sigmas = np.full(len(edges.pixels), np.nan), np.full(len(edges.pixels), np.nan)
    if not len(offsets):
        return offsets, sigmas, np.zeros(0, bool)
    far = reach_px + NEAR_PX
    s = np.arange(-far * SAMPLES_PER_PX, far * SAMPLES_PER_PX + 1) / SAMPLES_PER_PX
    where = (edges.pixels[:, None, :] + s[:, None] * edges.normals[:, None, :]).astype(np.float32)
    grey = cv2.remap(image.astype(np.float32), where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    grey = grey.astype(float)
    h, w = image.shape
    inside = (where >= 0).all(axis=2) & (where[..., 0] <= w - 1) & (where[..., 1] <= h - 1)
    start, step = _steepest(grey, inside, s, edges, reach_px)
    near = np.minimum(NEAR_PX, np.maximum(ROOM_SHARE * edges.room_px, 1.5))
    used = inside & (np.abs(s - start[:, None]) <= near[:, None])
    offset, sigma, height, noise = _fitted(grey, used, s, start, step)
    found = (np.abs(height) > STEP_SIGMAS * noise) & (np.abs(offset) <= reach_px)
    found &= (np.abs(offset - start) < near) & (used.sum(axis=1) >= 6) & (sigma < 1.0)
    found &= ~edges.signed | (height > 0)
    return np.where(found, offset, np.nan), np.where(found, sigma, np.nan), found


def _rings(helix: Helix, facing: float):
    """Both outer edges; light is beyond. Fields: names, azimuths, heights, slopes, light up or down, gaps, kinds."""
    if helix.ring_m == 0:
        return _no_points()
    sines = np.linspace(-VISIBLE, VISIBLE, RING_POINTS)
    azimuths = facing + np.arcsin(sines)
    parts = []
    for number, (height, light, collar) in enumerate(
        ((helix.bottom_m, -1.0, helix.lower_collar_m), (helix.top_m, 1.0, helix.upper_collar_m))
    ):
        if collar > 0:
            gap = min(collar, helix.ring_m)
            constant = (np.full(RING_POINTS, each) for each in (height, 0.0, light, gap, Kind.RING))
            parts.append((number * RING_POINTS + np.arange(RING_POINTS), azimuths, *constant))
    if not parts:
        return _no_points()
    return tuple(np.concatenate(each) for each in zip(*parts, strict=True))


def _stripes(helix: Helix, facing: float, heading: float):
    """Edges of the helix on generators at fixed azimuths from the facing one. A name is generator and turn."""
    azimuths = facing + np.arcsin(np.linspace(-VISIBLE, VISIBLE, GENERATORS))
    period = helix.pitch_m / helix.stripes
    most = int(np.ceil((helix.helix_top_m - helix.helix_bottom_m) / period)) + 1
    turned = (azimuths - heading - helix.start_rad) / (2 * np.pi)
    shift = np.floor(helix.stripes * turned[GENERATORS // 2])  # the lowest turn in view, so that names stay small
    number, turn, falling = np.meshgrid(np.arange(GENERATORS), np.arange(-2, most + 2), np.arange(2), indexing="ij")
    heights = helix.helix_bottom_m + helix.pitch_m * turned[number] + (turn - shift + helix.duty * falling) * period
    low, high = helix.helix_bottom_m, helix.helix_top_m
    within = (heights > low) & (heights < high)
    number, turn, falling, heights = number[within], turn[within], falling[within], heights[within]
    gap = np.minimum.reduce(
        [np.full(heights.shape, period * min(helix.duty, 1 - helix.duty)), heights - low, high - heights]
    )
    names = 10_000 * (2 + turn + 2) + 100 * number + 10 * falling
    slopes = np.full(heights.shape, helix.pitch_m / (2 * np.pi))
    lights = np.where(falling == 1, 1.0, -1.0)
    return names, azimuths[number], heights, slopes, lights, gap, np.full(heights.shape, Kind.STRIPE)


def _silhouettes(helix: Helix, facing: float, limb: float):
    bottom, top = helix.bottom_m - helix.lower_collar_m, helix.top_m + helix.upper_collar_m
    share = (np.arange(SILHOUETTE_POINTS) + 0.5) / SILHOUETTE_POINTS
    heights = np.tile(bottom + share * (top - bottom), 2)
    sides = np.repeat([-1.0, 1.0], SILHOUETTE_POINTS)
    names = 1000 + np.arange(len(sides))
    zero = np.zeros(len(sides))
    return names, facing + sides * limb, heights, zero, zero, zero, np.full(len(sides), Kind.SILHOUETTE)


def _no_points():
    return tuple(np.zeros(0) for _ in range(7))


def _nothing() -> ModelEdges:
    none = np.zeros(0)
    return ModelEdges(
        none, np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 3)), none, none, none > 0
    )


def _steepest(grey, inside, s, edges: ModelEdges, reach_px: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) where a profile is steepest in the right sense, and (N,) how high the step is about there."""
    kernel = np.arange(-3, 4) / SAMPLES_PER_PX
    kernel = kernel * np.exp(-0.5 * (kernel / BLUR_PX) ** 2)
    kernel /= np.abs(kernel).sum() / 2
    slope = cv2.filter2D(grey, -1, kernel[None, :], borderType=cv2.BORDER_REPLICATE)
    strength = np.where(edges.signed[:, None], slope, np.abs(slope))
    reach = np.minimum(reach_px, np.maximum(edges.room_px / 2, 1.0))[:, None]
    strength = np.where(inside & (np.abs(s) <= reach), strength, -np.inf)
    best = strength.argmax(axis=1)
    return s[best], np.take_along_axis(slope, best[:, None], axis=1)[:, 0]


def _fitted(grey, used, s, start, step):
    """Gauss-Newton on level, height, offset and the logarithm of the blur of N profiles at once.

    Returns (N,) offsets, sigmas, heights of the steps, sigmas of a sample. The variance counts independent pixels:
    samples that are nearer than a pixel share their noise, and interpolation has smoothed it away in part.
    """
    weights = used.astype(float)
    count = np.maximum(weights.sum(axis=1), 1.0)
    offset, log_blur, height = start.copy(), np.full(len(start), np.log(BLUR_PX)), step.copy()
    level = (weights * (grey - height[:, None] * (s > offset[:, None]))).sum(axis=1) / count
    variance = np.full(len(start), 4.0)
    for _ in range(STEPS + 1):
        blur = np.exp(log_blur)[:, None]
        below, bell = smeared_step((s - offset[:, None]) / blur)
        residual = grey - level[:, None] - height[:, None] * below
        variance = np.maximum((weights * residual**2).sum(axis=1) / np.maximum(count - 4, 1), LEAST_GREY_SIGMA**2)
        by_offset = -height[:, None] * bell / blur
        by_blur = -height[:, None] * bell * (s - offset[:, None]) / blur
        jacobian = np.stack([np.ones_like(below), below, by_offset, by_blur], axis=2)
        weighted = jacobian * (weights / (variance[:, None] * SAMPLES_PER_PX))[:, :, None]
        normal = np.einsum("nsi,nsj->nij", weighted, jacobian)
        normal[:, 3, 3] += BLUR_SIGMA**-2
        normal[:, range(4), range(4)] += 1e-6
        gradient = np.einsum("nsi,ns->ni", weighted, residual)
        gradient[:, 3] += (np.log(BLUR_PX) - log_blur) / BLUR_SIGMA**2
        inverse = np.linalg.inv(normal)
        change = np.einsum("nij,nj->ni", inverse, gradient)
        level, height = level + change[:, 0], height + change[:, 1]
        offset = offset + np.clip(change[:, 2], -1.0, 1.0)
        log_blur = np.clip(log_blur + np.clip(change[:, 3], -0.5, 0.5), np.log(0.3), np.log(4.0))
    return offset, np.sqrt(inverse[:, 2, 2] / INTERPOLATED), height, np.sqrt(variance)
