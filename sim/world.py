"""A polygonal world with holes: what the simulator moves robots in, read from GeoJSON in metres.

The frame is the one of the file. Free space lies on the left of every directed edge: the outer ring runs
counter-clockwise, holes run clockwise. Exactly straight (180 degree) vertices are vertices like any other.
"""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely

from coopslam.errors import BadInput
from sim.ground import Patch, noise_factors
from sim.world_checks import parse_rings, require_simple_rings, require_world_scale, short, signed_area
from sim.world_geojson import parse_name, parse_world, read_json

WORLDS_DIR = Path(__file__).parents[1] / "datasets" / "worlds"


@dataclass(frozen=True, eq=False)
class World:
    """Rings of corners, not closed; ring 0 is the outer boundary, the others are holes.

    A corner is named by its flat index (0 .. n-1, rings one after the other) or by (ring, index in the ring).
    Wall `i` is the edge from corner `i` to corner `next_index[i]`. Raises BadInput when a ring runs the wrong way.
    """

    name: str
    rings: tuple[np.ndarray, ...]  # (n_i, 2) each; m
    patches: tuple[Patch, ...] = ()  # where odometry is noisier

    def __post_init__(self):
        for ring, corners in enumerate(self.rings):
            if (signed_area(corners) > 0) != (ring == 0):
                raise BadInput(f"world {self.name}: ring {ring} does not have free space on its left")

    @cached_property
    def points(self) -> np.ndarray:
        """(n, 2) all corners, m; read-only."""
        return _frozen(np.vstack(self.rings))

    @cached_property
    def offset(self) -> np.ndarray:
        """(rings,) flat index of each ring's first corner."""
        return _frozen(np.cumsum([0, *map(len, self.rings[:-1])]))

    @cached_property
    def ring_of(self) -> np.ndarray:
        """(n,) ring of each corner."""
        return _frozen(np.repeat(np.arange(len(self.rings)), [len(ring) for ring in self.rings]))

    @cached_property
    def next_index(self) -> np.ndarray:
        """(n,) flat index of the corner where the wall that leaves each corner ends."""
        return self._neighbours(1)

    @cached_property
    def prev_index(self) -> np.ndarray:
        """(n,) flat index of the corner where the wall that arrives at each corner starts."""
        return self._neighbours(-1)

    @cached_property
    def interior_angles(self) -> np.ndarray:
        """(n,) free angle at each corner in (0, 2 pi), ccw from the leaving wall back to the arriving wall."""
        leaving = self.points[self.next_index] - self.points
        arriving = self.points[self.prev_index] - self.points
        cross = leaving[:, 0] * arriving[:, 1] - leaving[:, 1] * arriving[:, 0]
        return _frozen(np.arctan2(cross, np.sum(leaving * arriving, axis=1)) % (2 * np.pi))

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The closed free space."""
        return shapely.Polygon(self.rings[0], self.rings[1:])

    @property
    def n(self) -> int:
        """Number of corners, all rings together."""
        return len(self.points)

    @property
    def holes(self) -> int:
        """Number of holes."""
        return len(self.rings) - 1

    @property
    def triangles_expected(self) -> int:
        """Number of triangles of any triangulation that uses every corner."""
        return self.n + 2 * self.holes - 2

    @property
    def perimeter_m(self) -> float:
        """Length of all walls."""
        return float(self.polygon.length)

    @property
    def area_m2(self) -> float:
        """Area of the free space."""
        return float(self.polygon.area)

    def interior_angle(self, flat: int) -> float:
        """One of `interior_angles`, rad."""
        return float(self.interior_angles[flat])

    def ring_index(self, flat: int) -> tuple[int, int]:
        """(ring, index in the ring) of a corner."""
        ring = int(self.ring_of[flat])
        return ring, int(flat - self.offset[ring])

    def flat_index(self, ring: int, index: int) -> int:
        """Flat index of a corner; IndexError when there is no such corner."""
        if not (0 <= ring < len(self.rings) and 0 <= index < len(self.rings[ring])):
            raise IndexError(f"world {self.name} has no corner {index} in ring {ring}")
        return int(self.offset[ring]) + index

    def noise_factors(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(N,) factors on the sigmas of true odometry along straight stretches between (N, 2) places, m.

        The square is averaged over the length; a stretch of no length (a turn) has the factor of its place.
        """
        return noise_factors(self.patches, starts, ends) if self.patches else np.ones(len(starts))

    def to_geojson(self) -> dict:
        """A Feature whose rings are closed, in the same order and direction; `world_from_geojson` reads it back.

        With patches a FeatureCollection: that feature, then one for each patch.
        """
        coordinates = [[*ring.tolist(), ring[0].tolist()] for ring in self.rings]
        feature = {
            "type": "Feature",
            "properties": {"name": self.name, "units": "m"},
            "geometry": {"type": "Polygon", "coordinates": coordinates},
        }
        if not self.patches:
            return feature
        return {"type": "FeatureCollection", "features": [feature, *(patch.to_geojson() for patch in self.patches)]}

    def _neighbours(self, step: int) -> np.ndarray:
        """(n,) flat index of the corner `step` places further along each corner's ring."""
        flat = np.split(np.arange(self.n), self.offset[1:])
        return _frozen(np.concatenate([np.roll(indices, -step) for indices in flat]))


def world_names() -> list[str]:
    """Names of the worlds in the repository."""
    return sorted(path.stem for path in WORLDS_DIR.glob("*.geojson"))


def load_world(path_or_name: str | Path) -> World:
    """A world of the repository by its name, or the one polygon of a GeoJSON file.

    Raises BadInput with one line that names file, ring and vertex (as they stand in the file) and what was expected.
    """
    text = str(path_or_name)
    if text in world_names():
        path = WORLDS_DIR / f"{text}.geojson"
    elif Path(text).suffix or Path(text).name != text or os.path.exists(text):
        path = Path(text)
    else:
        raise BadInput(
            f"no world {short(text)}; expected a path to a GeoJSON file or one of: {', '.join(world_names())}"
        )
    return world_from_geojson(read_json(path), where=str(path), default_name=path.stem)


def world_from_geojson(data: dict, where: str = "world", default_name: str = "world") -> World:
    """The one polygon of a GeoJSON object, and its patches; `where` begins every message. Raises BadInput."""
    coordinates, properties, patches = parse_world(data, where)
    rings = parse_rings(coordinates, where)
    require_world_scale(rings, properties.get("units"), where)
    require_simple_rings(rings, where)
    name = parse_name(properties, default_name, where)
    return World(name, tuple(_free_space_left(i, r) for i, r in enumerate(rings)), patches)


def _free_space_left(ring: int, corners: np.ndarray) -> np.ndarray:
    """The ring's corners in the direction that has free space on the left, from the same first corner."""
    if (signed_area(corners) > 0) != (ring == 0):
        corners = np.roll(corners[::-1], 1, axis=0)
    return _frozen(corners)


def _frozen(array: np.ndarray) -> np.ndarray:
    array = np.ascontiguousarray(array)
    array.setflags(write=False)
    return array
