"""What is seen from points, against shapely's answer for every single line of sight."""

import numpy as np
import pytest
import shapely
from visibility_graph import OWN_WORLDS, load_polygon, points_inside

from coopslam.planning.triangulated import triangulated
from coopslam.planning.visibility import view_from


@pytest.mark.parametrize("path", OWN_WORLDS, ids=lambda path: path.stem)
def test_corners_and_points_seen_from_anywhere(path):
    polygon = load_polygon(path)
    mesh = triangulated(polygon)
    corners = np.array(mesh.points)
    shapely.prepare(polygon)
    points = points_inside(polygon, 60, np.random.default_rng(3))
    at = [mesh.triangles_at(point) for point in points]
    for eye, eye_at in zip(points[:20], at[:20], strict=True):
        view = view_from(mesh, tuple(eye), eye_at)
        lines = shapely.linestrings(np.stack([np.broadcast_to(eye, corners.shape), corners], axis=1))
        assert view.vertices == set(np.flatnonzero(shapely.covers(polygon, lines)).tolist())
        lines = shapely.linestrings(np.stack([np.broadcast_to(eye, points.shape), points], axis=1))
        seen = [view.holds(tuple(point), where) for point, where in zip(points, at, strict=True)]
        assert seen == shapely.covers(polygon, lines).tolist()


def test_sight_touches_corners_and_runs_along_walls():
    """A row of teeth whose tips lie on one line: from its one end, along the tips, to the other."""
    teeth = shapely.Polygon([(0, 0), (1, 2), (2, 0), (3, 2), (4, 0), (5, 2), (6, 0), (6, 4), (0, 4)])
    mesh = triangulated(teeth)
    view = view_from(mesh, (0.0, 2.0), mesh.triangles_at((0.0, 2.0)))
    assert {(1.0, 2.0), (3.0, 2.0), (5.0, 2.0)} <= {mesh.points[v] for v in view.vertices}
    assert view.holds((6.0, 2.0), mesh.triangles_at((6.0, 2.0)))
    assert not view.holds((6.0, 1.999), mesh.triangles_at((6.0, 1.999)))
    along = view_from(mesh, (6.0, 4.0), mesh.triangles_at((6.0, 4.0)))
    assert {(6.0, 0.0), (0.0, 4.0)} <= {mesh.points[v] for v in along.vertices}


def test_from_a_corner_every_free_angle_is_seen():
    """The eye stands where two obstacles meet; it sees to both sides."""
    square = [(0, 0), (10, 0), (10, 10), (0, 10)]
    polygon = shapely.Polygon(square, [[(2, 2), (5, 5), (2, 5)], [(5, 5), (8, 5), (8, 8)]])
    mesh = triangulated(polygon)
    view = view_from(mesh, (5.0, 5.0), mesh.triangles_at((5.0, 5.0)))
    assert view.vertices == set(range(len(mesh.points)))
    assert view.holds((4.0, 9.0), mesh.triangles_at((4.0, 9.0))) and view.holds((6.0, 1.0), mesh.triangles_at((6, 1)))
    assert not view.holds((2.5, 4.6), mesh.triangles_at((2.5, 4.6)))
