"""Rendered pictures: edges against cv2.projectPoints, light against Lambert's law, noise against the photon law."""

from dataclasses import replace
from math import cos, inf, pi, sin, sqrt
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from shapely.geometry import Point, box

from coopslam.errors import BadInput
from coopslam.se2 import Pose2
from tests.test_camera import opencv_pixels
from tracker.antialias import sampled
from tracker.background import Background
from tracker.data_sheet import load_data_sheet
from tracker.render import Occluder, RenderSettings, render, render_background, target_box
from tracker.scene_light import Light
from tracker.sensor import Sensor
from tracker.target import Drum

SHEETS = Path(__file__).parents[1] / "datasets" / "calibrations"
HELIX = load_data_sheet(SHEETS / "helix_640x480.toml")
CUBE = load_data_sheet(SHEETS / "tag_cube_640x480.toml")
CAMERA, BARE = HELIX.camera, replace(HELIX.helix, body=())
EXACT = Sensor(200.0, 10.0, inf, 0.0, vignetting=0.0, defocus_px=0.0)
FLAT = RenderSettings(Light(1.0, 0.0), Background("plain", wall=0.45), EXACT)  # radiance is reflectance
DARK, LIGHT, BEHIND = 10 + 200 * 0.05, 10 + 200 * 0.85, 10 + 200 * 0.45
EDGE_PX = 0.02  # demanded of every edge; 8 bits alone leave about 0.005
POSES = [Pose2(1.0, 0.1, 0.4), Pose2(1.5, -0.5, 2.0), Pose2(3.0, 0.7, -2.5), Pose2(3.0, -1.2, 3.0)]


def exact(target, T, settings=FLAT, camera=CAMERA):
    return render(camera, target, T, settings, np.random.default_rng(0))


def crossing(profile, first, before, after):
    """Sub-pixel position at which a profile that starts at pixel `first` goes from one grey level to the other."""
    return first - 0.5 + ((np.asarray(profile, float) - after) / (before - after)).sum()


def facing(T, radius=0.1):
    """Azimuth in the observer's body, and the axis, of the generator that faces the camera."""
    axis, camera = np.array([T.x(), T.y()]), np.array([0.04, 0.0])
    return np.arctan2(*(camera - axis)[::-1]), axis, np.hypot(*(camera - axis))


def on_cylinder(axis, azimuth, height, radius=0.1):
    """(N, 3) points in the observer's body; azimuth counts in the observer's body."""
    azimuth, height = np.broadcast_arrays(azimuth, height)
    return np.column_stack([axis[0] + radius * np.cos(azimuth), axis[1] + radius * np.sin(azimuth), height])


@pytest.mark.parametrize("T", POSES)
@pytest.mark.parametrize("side", [-1, 1])
def test_silhouettes_are_the_tangent_planes(T, side):
    """A plan view: the generator that is seen as the outline is arccos(r / d) away from the facing one."""
    towards, axis, apart = facing(T)
    drum = SimpleNamespace(solids=(Drum(0.1, 0.12, 0.51, 0.85),))
    picture = exact(drum, T)
    outline = opencv_pixels(
        CAMERA, on_cylinder(axis, towards + side * np.arccos(0.1 / apart), np.linspace(0.15, 0.48, 200))
    )
    order = np.argsort(outline[:, 1])
    rows = np.arange(int(outline[:, 1].min()) + 3, int(outline[:, 1].max()) - 2)
    assert len(rows) > 30
    # azimuth grows counter-clockwise from above, so from the camera a larger one is further right
    before, after = (LIGHT, BEHIND) if side > 0 else (BEHIND, LIGHT)
    for row in rows:
        expected = np.interp(row, outline[order, 1], outline[order, 0])
        first = int(expected) - 5
        found = crossing(picture[row, first : first + 12], first, before, after)
        assert found == pytest.approx(expected, abs=EDGE_PX)


@pytest.mark.parametrize("T", POSES)
def test_ends_of_the_pattern_are_circles_at_their_heights(T):
    """Columns around the nearest points of the circles where light collars meet dark rings."""
    towards, axis, _ = facing(T)
    picture = exact(BARE, T)
    for height, before, after in ((0.48, LIGHT, DARK), (0.18, DARK, LIGHT)):
        circle = opencv_pixels(CAMERA, on_cylinder(axis, towards + np.linspace(-0.6, 0.6, 200), height))
        for column in np.rint(circle[60:140:10, 0]).astype(int):
            expected = np.interp(column, circle[:, 0], circle[:, 1])
            first = int(expected) - 3
            assert crossing(picture[first : first + 7, column], first, before, after) == pytest.approx(
                expected, abs=EDGE_PX
            )


@pytest.mark.parametrize("T", POSES)
def test_stripes_cross_the_facing_generator_where_the_heading_says(T):
    """z = 0.22 + 0.2 (phi / 2 pi + k / 2), phi = azimuth in the target's body; dark above it for whole k."""
    towards, axis, _ = facing(T)
    picture = exact(BARE, T)
    azimuth = towards + np.linspace(-0.3, 0.3, 200)
    checked = 0
    for half_turn in range(-6, 7):
        height = 0.22 + 0.2 * ((azimuth - T.theta()) / (2 * pi) + half_turn / 2)
        if height[0] < 0.24 or height[-1] > 0.42:  # clear of the rings
            continue
        curve = opencv_pixels(CAMERA, on_cylinder(axis, azimuth, height))
        upper, lower = (DARK, LIGHT) if half_turn % 2 == 0 else (LIGHT, DARK)
        for column in np.rint(curve[[70, 100, 130], 0]).astype(int):
            expected = np.interp(column, curve[:, 0], curve[:, 1])
            first = int(expected) - 3
            assert crossing(picture[first : first + 7, column], first, upper, lower) == pytest.approx(
                expected, abs=EDGE_PX
            )
            checked += 1
    assert checked >= 3


def tag_corners_seen(T):
    """Tag id -> (4, 2) pixels of its corners by cv2.projectPoints."""
    c, s = cos(T.theta()), sin(T.theta())
    seen = {}
    for tag, corners in CUBE.tag_cube.corners().items():
        x, y, z = corners.T
        seen[tag] = opencv_pixels(CUBE.camera, np.column_stack([T.x() + c * x - s * y, T.y() + s * x + c * y, z]))
    return seen


def straightened(pixels):
    """(N, 2) pixels of the same camera without distortion, by OpenCV."""
    lens, until = CUBE.camera.lens, (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    points = np.asarray(pixels, float)[:, None]
    return cv2.undistortPoints(points, lens.matrix, lens.distortion, P=lens.matrix, criteria=until)[:, 0]


def border_line(picture, start, end, inwards):
    """(3,) homogeneous line through the sub-pixel crossings of a tag's border between two of its corners."""
    steep = int(abs(end[1] - start[1]) > abs(end[0] - start[0]))  # crossings are then searched along rows
    places, crossings = (
        np.arange(*sorted(np.rint([0.85 * start + 0.15 * end, 0.15 * start + 0.85 * end])[:, steep])),
        [],
    )
    for place in places.astype(int):
        guess = np.interp(
            (place - start[steep]) / (end[steep] - start[steep]), [0, 1], [start[1 - steep], end[1 - steep]]
        )
        first = int(guess) - 4
        profile = (picture[place] if steep else picture[:, place])[first : first + 9]
        before, after = (LIGHT, DARK) if inwards[1 - steep] > 0 else (DARK, LIGHT)
        found = crossing(profile, first, before, after)
        crossings.append([found, place] if steep else [place, found])
    points = straightened(crossings)
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle)[2][1]
    return np.array([*normal, -normal @ middle])


@pytest.mark.parametrize("T", [Pose2(0.8, 0.0, pi), Pose2(0.9, 0.1, 2.7), Pose2(1.0, -0.2, -2.0), Pose2(1.0, 0.1, 0.6)])
def test_tags_are_where_their_corners_are_projected(T):
    """OpenCV reads the right tags there; lines through their borders meet within 0.02 pixels of the corners.

    OpenCV's own corners serve for 0.5 pixels only: on its own drawing of a tag, averaged over pixels without our
    renderer, its CORNER_REFINE_SUBPIX is 0.12 to 0.33 pixels inside, growing with blur, and APRILTAG (0.5, 0.5) off.
    """
    picture = exact(replace(CUBE.tag_cube, body=()), T)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detected, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(picture)
    assert ids is not None
    seen, measured = tag_corners_seen(T), 0
    for found, tag in zip(detected, ids.ravel(), strict=True):
        expected = seen[tag]
        assert np.abs(found[0] - expected).max() < 0.5
        lengths = np.linalg.norm(expected - np.roll(expected, -1, axis=0), axis=1)
        if lengths.min() / 8 < 10:  # a module must be wider than the profiles across its edge
            continue
        middle = expected.mean(axis=0)
        sides = zip(expected, np.roll(expected, -1, axis=0), strict=True)
        lines = [border_line(picture, a, b, middle - (a + b) / 2) for a, b in sides]
        meet = np.array([np.cross(lines[k - 1], lines[k]) for k in range(4)])
        assert np.abs(meet[:, :2] / meet[:, 2:] - straightened(expected)).max() < EDGE_PX
        measured += 1
    assert measured >= 1


def test_lambert_on_the_cylinder():
    """Level light from straight behind the camera: E = 0.4 + 0.6 cos(angle off the facing generator)."""
    T = Pose2(2.0, 0.0, 1.0)
    settings = replace(FLAT, light=Light(0.4, 0.6, azimuth_rad=pi, elevation_rad=0.0))
    picture = exact(SimpleNamespace(solids=(Drum(0.1, 0.12, 0.51, 0.85),)), T, settings)
    for angle, expected in ((0.0, 10 + 200 * 0.85), (pi / 3, 10 + 200 * 0.85 * 0.7), (-pi / 3, 10 + 200 * 0.85 * 0.7)):
        u, v = opencv_pixels(CAMERA, on_cylinder([2.0, 0.0], pi + angle, 0.3))[0]
        row = picture[int(round(v))].astype(float)
        assert np.interp(u, np.arange(640), row) == pytest.approx(expected, abs=0.8)  # rounding, and the row's own v


@pytest.mark.parametrize(("heading", "irradiance"), [(pi, 0.3 + 0.5 * 0.8), (pi - pi / 3, 0.3 + 0.5 * 0.8 * 0.5)])
def test_lambert_on_the_cube(heading, irradiance):
    """A light of elevation asin 0.6 behind the camera: cos = 0.8 on an upright face towards it, half at 60 degrees."""
    T = Pose2(2.0, 0.0, heading)
    settings = replace(FLAT, light=Light(0.3, 0.5, azimuth_rad=pi, elevation_rad=np.arcsin(0.6)))
    picture = exact(replace(CUBE.tag_cube, body=()), T, settings)
    margin = np.array([0.15, 0.0, 0.18 + 0.015])  # the white border under tag 0
    seen = [[T.x() + cos(heading) * margin[0], sin(heading) * margin[0], margin[2]]]
    u, v = np.rint(opencv_pixels(CAMERA, seen)[0]).astype(int)
    assert picture[v, u] == round(10 + 200 * 0.85 * irradiance)


def test_light_keeps_its_place_when_the_target_turns():
    light = Light(0.0, 1.0, azimuth_rad=0.7, elevation_rad=0.3)
    turned = light.direction(frame_heading_rad=0.7)
    np.testing.assert_allclose(turned, [cos(0.3), 0.0, sin(0.3)], atol=1e-15)


def pixels(cells):
    """Mean over the four cells of each pixel."""
    return cells.reshape(len(cells) // 2, 2, -1, 2).mean(axis=(1, 3))


def test_area_sampling_of_a_disc_against_shapely():
    """Coverage of each pixel by a disc of radius 6.3 px, and of each cell."""
    v, u = np.mgrid[0:21, 0:21] - 0.5
    corners = np.stack([u, v], axis=-1)

    def shade(points):
        inside = np.hypot(points[0] - 9.3, points[1] - 10.1) < 6.3
        return inside * 0.7, np.where(inside, 0, -1)

    found = sampled(corners, shade)
    disc = Point(9.3, 10.1).buffer(6.3, quad_segs=2000)
    expected = np.array(
        [
            [4 * disc.intersection(box(x, y, x + 0.5, y + 0.5)).area for x in np.arange(-0.5, 19.5, 0.5)]
            for y in np.arange(-0.5, 19.5, 0.5)
        ]
    )
    assert np.abs(found.coverage - expected).max() < 0.04
    assert np.abs(pixels(found.coverage) - pixels(expected)).max() < 0.01
    np.testing.assert_allclose(found.radiance, 0.7 * found.coverage, atol=1e-12)
    # Chords of length l cut l^2 / 12 per radian off a circle's area; across a cell l is at most sqrt(1 / 2).
    assert 0 <= pi * 6.3**2 - pixels(found.coverage).sum() <= 2 * pi * 0.5 / 12


@pytest.mark.parametrize("place", np.linspace(3.0, 4.0, 11))
@pytest.mark.parametrize("axis", [0, 1])
def test_area_sampling_of_an_edge_along_the_pixels(place, axis):
    v, u = np.mgrid[0:9, 0:9] - 0.5
    label = lambda points: np.where(points[axis] < place, 0, -1)  # noqa: E731
    found = sampled(np.stack([u, v], axis=-1), lambda points: (label(points) + 1.0, label(points)))
    assert pixels(found.coverage).sum(axis=1 - axis).mean() == pytest.approx(
        place + 0.5, abs=1 / 1000
    )  # of the bisection


def test_what_is_nearer_hides_what_is_behind():
    near, far = Drum(0.1, 0.0, 0.4, 0.9, forward_m=0.0), Drum(0.2, 0.0, 0.5, 0.1, forward_m=1.0)
    for solids in ((near, far), (far, near)):
        picture = exact(SimpleNamespace(solids=solids), Pose2(2.0, 0.0, 0.0))
        u, v = np.rint(opencv_pixels(CAMERA, [[1.9, 0.0, 0.3]])[0]).astype(int)
        assert picture[v, u] == 190
    u, v = np.rint(opencv_pixels(CAMERA, [[2.0 + 0.8, 0.15, 0.45]])[0]).astype(int)
    assert picture[v, u] == 30


@pytest.mark.parametrize("T", [Pose2(-2, 0, 0), Pose2(0.5, 5, 0), Pose2(20, -20, 0)])
def test_out_of_view_is_the_background_alone(T):
    settings = RenderSettings(background=Background("gradient"))
    alone = render_background(CAMERA, settings, np.random.default_rng(4))
    np.testing.assert_array_equal(render(CAMERA, BARE, T, settings, np.random.default_rng(4)), alone)


def test_box_holds_the_target_and_little_more():
    for T in POSES:
        changed = np.argwhere(exact(BARE, T) != BEHIND)
        rows, columns = target_box(CAMERA, BARE.solids, T)
        low, high = changed.min(axis=0), changed.max(axis=0)
        for edge, first, last in ((rows, low[0], high[0]), (columns, low[1], high[1])):
            assert 0 <= first - edge.start <= 5 and 0 <= edge.stop - 1 - last <= 5


def test_occluder_covers_pixels_in_part():
    settings = replace(FLAT, occluders=(Occluder(100.25, 50.0, 20.5, 10.0, radiance=0.95),))
    picture = render_background(CAMERA, settings, np.random.default_rng(0))
    # covers x from 100.25 to 120.75: a quarter of pixel 100 (which ends at 100.5), all to 120, a quarter of 121
    assert picture[55, [99, 100, 101, 120, 121, 122]].tolist() == [100, 125, 200, 200, 125, 100]
    assert picture[[49, 50, 51, 59, 60, 61], 110].tolist() == [100, 150, 200, 200, 150, 100]


def test_noise_follows_the_photon_transfer_law():
    """variance = signal / K + (read / K)^2 + 1 / 12 of rounding, for 300 000 pixels; the mean stays."""
    sensor = Sensor(200.0, 10.0, 40.0, 12.0, vignetting=0.0, defocus_px=0.0)
    picture = sensor.picture(np.full((960, 1280), 0.5, np.float32), np.random.default_rng(3)).astype(float)
    variance = 100 / 40 + (12 / 40) ** 2 + 1 / 12
    count = picture.size
    assert picture.mean() == pytest.approx(110, abs=4 * sqrt(variance / count))
    assert picture.var() == pytest.approx(variance, rel=4 * sqrt(2 / count))


def test_defocus_is_a_gaussian():
    """Of the cells, before pixels take their mean."""
    radiance = np.random.default_rng(5).uniform(0, 1, (80, 100)).astype(np.float32)
    found = replace(EXACT, defocus_px=1.3).exposed(radiance)
    expected = 10 + 200 * pixels(gaussian_filter(radiance.astype(float), 2.6, mode="reflect", truncate=8))
    np.testing.assert_allclose(found[8:-8, 8:-8], expected[8:-8, 8:-8], atol=0.02)  # cv2 cuts at four sigma


@pytest.mark.parametrize("direction", [0.0, pi / 2, 0.6])
def test_motion_draws_a_line(direction):
    """Of a point: second moment L^2 / 12 along the line; shared bilinearly, at most 1 / 4 more on each axis."""
    radiance = np.zeros((82, 82), np.float32)
    radiance[40:42, 40:42] = 1.0
    light = (replace(EXACT, motion_px=9.0, motion_rad=direction).exposed(radiance) - 10) / 200
    v, u = np.mgrid[-20:21, -20:21]
    assert light.sum() == pytest.approx(1.0, abs=1e-5)
    assert (light * u).sum() == pytest.approx(0.0, abs=1e-5) and (light * v).sum() == pytest.approx(0.0, abs=1e-5)
    for offset, share in ((u, cos(direction)), (v, sin(direction))):
        assert -1e-4 <= (light * offset**2).sum() - 81 / 12 * share**2 <= 0.25 + 1e-4
    assert (light * u * v).sum() == pytest.approx(81 / 12 * cos(direction) * sin(direction), abs=0.02)


def test_vignetting_takes_light_from_the_corners():
    grey = replace(EXACT, vignetting=0.2).exposed(np.ones((962, 1282), np.float32))
    assert grey[240, 320] == pytest.approx(210) and grey[0, 0] == pytest.approx(10 + 200 * 0.8)
    half_way = 10 + 200 * (1 - 0.2 * 160**2 / (240**2 + 320**2))
    assert grey[240, 480] == pytest.approx(half_way, abs=0.01)  # pixels counted, not their spacing


@pytest.mark.parametrize("kind", ["plain", "gradient", "clutter"])
def test_a_picture_depends_on_nothing_but_its_arguments(kind):
    settings = RenderSettings(background=Background(kind))
    one, same, other = (render(CAMERA, HELIX.helix, POSES[2], settings, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert one.shape == (480, 640) and one.dtype == np.uint8
    assert (one != other).mean() > 0.5


def test_clutter_leaves_the_target_alone():
    """Where the target covers pixels wholly, the picture without noise and blur does not depend on what is behind."""
    plain = exact(HELIX.helix, POSES[2])
    cluttered = exact(HELIX.helix, POSES[2], replace(FLAT, background=Background("clutter")))
    black = exact(HELIX.helix, POSES[2], replace(FLAT, background=Background("plain", wall=0.0)))
    covered = plain == black
    assert covered.sum() > 1000
    np.testing.assert_array_equal(cluttered[covered], plain[covered])
    assert cluttered[~covered].std() > 5


def test_a_given_background_is_taken_and_left_as_it_was():
    drawn = Background("clutter").radiance(CAMERA, np.random.default_rng(7), 3.5)
    before = drawn.copy()
    picture = render(CAMERA, BARE, POSES[2], FLAT, np.random.default_rng(0), background=drawn)
    np.testing.assert_array_equal(drawn, before)
    rows, columns = target_box(CAMERA, BARE.solids, POSES[2])
    outside = np.ones(picture.shape, bool)
    outside[rows, columns] = False
    np.testing.assert_allclose(picture[outside], np.clip(10 + 200 * drawn, 0, 255)[outside], atol=0.501)


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (Light, "ambient", -0.1),
        (Light, "elevation_rad", 2.0),
        (Background, "wall", -1.0),
        (Background, "wall_m", 0.0),
        (Sensor, "electrons_per_level", 0.0),
        (Sensor, "defocus_px", -1.0),
        (Sensor, "vignetting", 1.5),
        (Sensor, "motion_px", float("nan")),
    ],
)
def test_impossible_settings_are_refused(kind, field, value):
    with pytest.raises(BadInput, match=f"^{field}: "):
        kind(**{field: value})
