"""Slippery patches: parts of the floor on which odometry is noisier, or less noisy, than the sensor's law says."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from coopslam.errors import BadInput
from sim.world_checks import FARTHEST_M, parse_rings, require_simple_rings, short

LARGEST_FACTOR = 100.0
PROPERTIES = ("kind", "noise_factor", "name", "description", "units")  # that a patch may have
SPOT_M = 1e-9  # a shorter stretch is a place


@dataclass(frozen=True, eq=False)
class Patch:
    """A simple polygon, boundary included, where every sigma of true odometry is `noise_factor` times as large.

    Raises BadInput when the factor is not more than zero and at most 100.
    """

    ring: np.ndarray  # (n, 2) m, not closed, either direction; may reach outside the world
    noise_factor: float

    def __post_init__(self):
        if not 0 < self.noise_factor <= LARGEST_FACTOR:
            raise BadInput(f"noise_factor: more than zero and at most 100 expected, got {self.noise_factor}")

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The patch, closed."""
        polygon = shapely.Polygon(self.ring)
        shapely.prepare(polygon)
        return polygon

    def to_geojson(self) -> dict:
        """A Feature whose ring is closed; `parse_patch` reads it back."""
        return {
            "type": "Feature",
            "properties": {"kind": "slippery", "noise_factor": self.noise_factor},
            "geometry": {"type": "Polygon", "coordinates": [[*self.ring.tolist(), self.ring[0].tolist()]]},
        }


def noise_factors(patches: Sequence[Patch], starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(N,) factors on the odometry sigmas along straight stretches, whose (N, 2) ends are metres in the world.

    Variances of a random walk add up, so it is the square that is averaged over the length. Where patches overlap
    the largest factor counts; outside of all it is 1. A stretch of no length has the factor of its place.
    """
    lengths = np.hypot(*(ends - starts).T)
    squares = np.ones(len(lengths))
    driven = lengths > SPOT_M
    places = shapely.points(starts[~driven])
    rest = shapely.linestrings(np.stack([starts[driven], ends[driven]], axis=1))
    open_m = lengths[driven].copy()
    weighted = np.zeros(len(rest))
    at_place = np.zeros(len(places))
    for patch in sorted(patches, key=lambda patch: -patch.noise_factor):
        at_place[(at_place == 0) & shapely.intersects(patch.polygon, places)] = patch.noise_factor**2
        covered_m = shapely.length(shapely.intersection(rest, patch.polygon))
        weighted += patch.noise_factor**2 * covered_m
        open_m -= covered_m
        rest = shapely.difference(rest, patch.polygon)
    squares[driven] = (weighted + np.maximum(open_m, 0.0)) / lengths[driven]
    squares[~driven] = np.where(at_place > 0, at_place, 1.0)
    return np.sqrt(squares)


def is_patch(feature) -> bool:
    """Whether a GeoJSON object says of itself that it is a slippery patch."""
    properties = feature.get("properties") if isinstance(feature, dict) else None
    return isinstance(properties, dict) and properties.get("kind") == "slippery"


def parse_patch(feature: dict, where: str) -> Patch:
    """The patch of a Feature with `properties.kind` "slippery"; `where` begins every message. Raises BadInput."""
    properties, geometry = feature["properties"], feature.get("geometry")
    for name in properties:
        if name not in PROPERTIES:
            raise BadInput(f"{where}: unknown property {short(name)}; known properties: {', '.join(PROPERTIES)}")
    units, factor = properties.get("units"), properties.get("noise_factor")
    if units is not None and units != "m":
        raise BadInput(f'{where}: properties.units is {short(units)}; "m" (metres) expected')
    if "noise_factor" not in properties:
        raise BadInput(f"{where}: noise_factor is missing; a number more than zero and at most 100 expected")
    is_number = isinstance(factor, int | float) and not isinstance(factor, bool)
    if not (is_number and 0 < factor <= LARGEST_FACTOR):
        raise BadInput(
            f"{where}: properties.noise_factor is {short(factor)}; a number more than zero and at most 100 expected"
        )
    if not isinstance(geometry, dict) or geometry.get("type") != "Polygon":
        kind = geometry.get("type") if isinstance(geometry, dict) else geometry
        raise BadInput(f"{where}: the geometry is {short(kind)}; a Polygon expected")
    rings = parse_rings(geometry.get("coordinates"), where)
    if len(rings) != 1:
        raise BadInput(f"{where}: the polygon has {len(rings)} rings; one (no holes) expected")
    if np.abs(rings[0]).max() > FARTHEST_M:
        reach = f"coordinates reach {np.abs(rings[0]).max():.6g} m"
        raise BadInput(f"{where}: {reach}; at most {FARTHEST_M:g} m expected")
    require_simple_rings(rings, where)
    rings[0].setflags(write=False)
    return Patch(rings[0], float(factor))
