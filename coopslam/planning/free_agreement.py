"""Does what one map knows to be free contradict what the other one knows to be a wall or a corner?"""

from collections.abc import Sequence

import numpy as np
import shapely

from coopslam.planning.corner_map import UNKNOWN, CornerMap, relative_poses
from coopslam.planning.map_fit import Fit, turned
from coopslam.se2 import xytheta

SLACK_M = 0.15  # free space nearer than this to its own border contradicts nothing
SLACK_SIGMAS = 5.0


class FreeSpace:
    """The free space and the walls of a stored map, and whether a small map agrees with them."""

    def __init__(self, stored: CornerMap):
        self.stored = stored
        self._inner = free_polygon(stored.places, stored.triangles).buffer(-SLACK_M)
        shapely.prepare(self._inner)
        self.walls = [(start, int(end)) for start, end in enumerate(stored.leaving) if end != UNKNOWN]

    def contradiction(self, small: CornerMap, fit: Fit) -> str:
        """What a fit gets wrong, in words; empty when nothing is.

        Paired corners stand where the stored map has them, the others where the pose of the fit puts them, give or take
        their sigma there. What both maps leave open of one place relative to another has to be exceeded.
        """
        return self._in_what_was_seen(small, fit) or self._in_what_is_stored(small, fit)

    def _in_what_was_seen(self, small: CornerMap, fit: Fit) -> str:
        """A wall or corner of the stored map where the small one is free."""
        seen = free_polygon(self._placed(small, fit), small.triangles)
        slack = SLACK_M + SLACK_SIGMAS * _unpaired_sigma_m(small, fit)
        inner, paired = seen.buffer(-slack), {j for _, j in fit.pairs}
        shapely.prepare(inner)
        for start, end in self.walls:
            wall = shapely.LineString(self.stored.places[[start, end]])
            if inner.intersects(wall):
                doubt = SLACK_SIGMAS * self._sigma_m([start, end], fit)
                if seen.buffer(-slack - doubt).intersects(wall):
                    return "a wall of the stored map would stand in free space"
        for j in np.flatnonzero(shapely.contains_xy(inner, self.stored.places)).tolist():
            doubt = SLACK_SIGMAS * self._sigma_m([j], fit)
            if j not in paired and shapely.contains_xy(seen.buffer(-slack - doubt), *self.stored.places[j]):
                return "a corner of the stored map would stand in free space"
        return ""

    def _in_what_is_stored(self, small: CornerMap, fit: Fit) -> str:
        """A wall or corner of the small map where the stored one is free."""
        places, paired = self._placed(small, fit), {i for i, _ in fit.pairs}
        unpaired = [i for i in range(len(places)) if i not in paired]
        walls = [places[[start, end]] for start, end in enumerate(small.leaving) if end != UNKNOWN]
        inside = self._inner.intersects(shapely.MultiLineString(walls)) if walls else False
        if not inside and not shapely.contains_xy(self._inner, places[unpaired]).any():
            return ""
        low, high = places.min(axis=0) - SLACK_M, places.max(axis=0) + SLACK_M
        around = np.flatnonzero(((self.stored.places >= low) & (self.stored.places <= high)).all(axis=1)).tolist()
        doubt = SLACK_SIGMAS * (_unpaired_sigma_m(small, fit) + self._sigma_m(around, fit))
        surely_inner = self._inner.buffer(-doubt)
        if shapely.contains_xy(surely_inner, places[unpaired]).any():
            return "a corner would stand where the stored map is free"
        if walls and surely_inner.intersects(shapely.MultiLineString(walls)):
            return "a wall would stand in the free space of the stored map"
        return ""

    def _placed(self, small: CornerMap, fit: Fit) -> np.ndarray:
        """(n, 2) corners of the small map in the frame of the stored one."""
        x, y, turn = xytheta(fit.T_stored_small)
        places = turned(turn, small.places) + (x, y)
        for i, j in fit.pairs:
            places[i] = self.stored.places[j]
        return places

    def _sigma_m(self, corners: Sequence[int], fit: Fit) -> float:
        """How far off stored corners may be, relative to any of the paired ones; zero for no corners."""
        paired = np.array([j for _, j in fit.pairs])
        covs = [relative_poses(self.stored, corner, paired)[1][:, :2, :2] for corner in corners]
        return float(np.sqrt(max((np.linalg.eigvalsh(cov)[:, -1].max() for cov in covs), default=0.0)))


def _unpaired_sigma_m(small: CornerMap, fit: Fit) -> float:
    """How far off the farthest unpaired corner may be; zero when there is none."""
    if len(fit.pairs) == len(small.ids):
        return 0.0
    own = np.einsum("kikj->kij", small.covariance)[:, :2, :2]
    spread = np.sqrt(np.linalg.eigvalsh(own)[:, -1].max()) + np.sqrt(np.linalg.eigvalsh(fit.cov_small[:2, :2])[-1])
    lever_m = np.hypot(*small.places.T).max()
    return float(spread + lever_m * np.sqrt(fit.cov_small[2, 2]))


def free_polygon(places: np.ndarray, triangles: np.ndarray) -> shapely.Geometry:
    """The union of triangles, (t, 3) indices of (n, 2) places."""
    if len(triangles) == 0:
        return shapely.Polygon()
    return shapely.union_all(shapely.buffer(shapely.polygons(places[triangles]), 0.0))
