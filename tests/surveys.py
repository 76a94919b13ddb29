"""Corner maps of polygons whose corners were surveyed with drawn errors: for tests of place recognition."""

import numpy as np
import shapely

from coopslam.planning.corner_map import UNKNOWN, CornerMap
from coopslam.se2 import Pose2, wrap, xytheta

SIGMAS = np.array([0.05, 0.05, 0.03])  # of each corner, m, m, rad
ANGLE_SIGMA_RAD = 0.02
WORLD = Pose2()


def oriented_corners(ring: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) poses and (n,) interior angles of a ring with free space on its left."""
    leaving, arriving = np.roll(ring, -1, axis=0) - ring, np.roll(ring, 1, axis=0) - ring
    headings = np.arctan2(leaving[:, 1], leaving[:, 0])
    angles = (np.arctan2(arriving[:, 1], arriving[:, 0]) - headings) % (2 * np.pi)
    return np.column_stack([ring, headings]), angles


def covariance(count: int, rng: np.random.Generator) -> np.ndarray:
    """(3 count, 3 count): independent errors, and a part that all corners share in random proportions."""
    scale = np.tile(SIGMAS, count)
    common = rng.standard_normal((3 * count, 3))
    return (np.eye(3 * count) + common @ common.T) * np.outer(scale, scale)


def survey(
    ring: np.ndarray,
    rng: np.random.Generator,
    T_map_world: Pose2 = WORLD,
    corners: list[int] | None = None,
    scale: float = 1.0,
    triangles: np.ndarray | None = None,
) -> CornerMap:
    """A polygon without holes as it was surveyed: all of it, or some corners of it.

    The errors are drawn from the covariance that the map has.  scale: of all sigmas.  triangles: (t, 3) corners that
    are known to be free; without them a fan of those chosen.
    """
    poses, angles = oriented_corners(np.asarray(ring, float))
    chosen = list(range(len(poses))) if corners is None else corners
    cov = scale**2 * covariance(len(chosen), rng)
    errors = rng.multivariate_normal(np.zeros(len(cov)), cov).reshape(-1, 3)
    measured = [
        xytheta(T_map_world * Pose2(*poses[k]) * Pose2(*error)) for k, error in zip(chosen, errors, strict=True)
    ]
    n, number = len(poses), {corner: k for k, corner in enumerate(chosen)}
    if triangles is None:
        fan = [(chosen[0], *pair) for pair in zip(chosen[1:], chosen[2:], strict=False)]
        triangles = triangulated(poses[:, :2]) if corners is None else fan
    noise = scale * ANGLE_SIGMA_RAD * rng.standard_normal(len(chosen))
    return CornerMap(
        tuple(range(len(chosen))),
        np.array(measured),
        cov.reshape(len(chosen), 3, len(chosen), 3),
        angles[chosen] + noise,
        scale * ANGLE_SIGMA_RAD,
        np.array([number.get((corner + 1) % n, UNKNOWN) for corner in chosen]),
        np.array([number.get((corner - 1) % n, UNKNOWN) for corner in chosen]),
        np.array([[number[corner] for corner in triangle] for triangle in triangles]),
        np.empty((0, 2), int) if corners is None else np.array([[0, len(chosen) - 1]]),
        corners is None,
    )


def triangulated(points: np.ndarray) -> np.ndarray:
    """(n - 2, 3) corners of the triangles of a polygon, counter-clockwise."""
    parts = shapely.constrained_delaunay_triangles(shapely.Polygon(points)).geoms
    corners = [shapely.get_coordinates(shapely.Polygon(part).normalize().reverse())[:3] for part in parts]
    return np.array([[int(np.argmin(np.hypot(*(points - corner).T))) for corner in part] for part in corners])


def same_pose(one: Pose2, other: Pose2, metres: float, radians: float) -> bool:
    """Whether two poses are near each other."""
    apart = one.between(other)
    return bool(np.hypot(apart.x(), apart.y()) < metres and abs(wrap(apart.theta())) < radians)
