"""The free map of an earlier exploration, from the decisions in its log."""

from collections.abc import Iterable

from coopslam.errors import BadRecord
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.chart import Chart, ChartSettings
from coopslam.exploration.free_map import FreeMap, MapConflict
from coopslam.exploration.recognition import Walked, fitting_sector
from coopslam.records import CornerDecision, Record, TriangleDecision, WallDecision


def rebuilt_map(records: Iterable[Record], estimate: Estimate) -> FreeMap:
    """Decide again what was decided then.

    estimate: of all vertices; it tells into which unexplored sector of a known apex a triangle fits, which no decision
    says.  Raises BadRecord when the decisions contradict each other, or name vertices that were never new.
    """
    rebuilding = _Rebuilding(estimate)
    try:
        for record in records:
            rebuilding.take(record)
        rebuilding.finish_wall()
    except (MapConflict, KeyError) as error:
        raise BadRecord(f"the decisions in the log make no map: {error}") from error
    return rebuilding.free_map


class _Rebuilding:
    """A map that grows; a wall waits until the record after it tells whether it is the side of a triangle."""

    def __init__(self, estimate: Estimate):
        self.free_map = FreeMap()
        self._chart = Chart(self.free_map, ChartSettings())
        self._chart.look_at(estimate)
        self._wall: WallDecision | None = None

    def take(self, record: Record) -> None:
        """One record; those that decide nothing of the map are passed over."""
        match record:
            case CornerDecision(is_new=True):
                self.finish_wall()
                self.free_map.add_vertex(record.vertex, record.sighting.interior_angle_rad)
            case WallDecision():
                self.finish_wall()
                self._wall = record
            case TriangleDecision():
                self._add_triangle(record)

    def finish_wall(self) -> None:
        """A wall that is no triangle's side is the first one, or closes the gate that ran along it."""
        wall, self._wall = self._wall, None
        if wall is None:
            return
        if not self.free_map.walls():
            self.free_map.add_first_wall(wall.start, wall.end)
        else:
            self.free_map.close_as_wall((wall.end, wall.start))

    def _add_triangle(self, decision: TriangleDecision) -> None:
        a, b, apex = decision.vertices
        wall, sides = self._wall, {(b, apex): Walked(at_end=True), (apex, a): Walked(at_start=True)}
        walked = sides.get((wall.start, wall.end)) if wall else None
        if walked is None:
            self.finish_wall()
            walked = Walked()
        self._wall = None
        sector, _ = fitting_sector(self._chart, apex, (a, b), walked)
        triangle = self.free_map.add_triangle((a, b), apex, walked.at_end, walked.at_start, sector and sector.index)
        if triangle != decision.triangle:
            raise MapConflict(f"triangle {decision.triangle} comes after {triangle - 1}")
