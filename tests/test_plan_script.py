"""plan.py on finished runs: the paths it writes against shapely and brute force, exit codes, one line for an error."""

import json
import shutil

import networkx as nx
import numpy as np
import pytest
import shapely
from explore_script import SCRIPTS, call, load, require_one_line  # noqa: F401 puts the scripts on the path
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import damaged
from visibility_graph import VisibilityGraph

from _cli import run  # isort: skip
from plan import main  # isort: skip

START, GOAL = (1.0, 1.0), (6.0, 4.0)  # of the world with one obstacle, which stands between


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "run"
    assert call("--world", "paper_one_obstacle", "--seed", 3, "--out", out, "--figures", "none") == 0
    return out


def plan(*arguments) -> int:
    try:
        return run(main, [str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


def planned(run_dir, out, *arguments) -> tuple[dict, list[dict]]:
    """plan.json and the features of the paths."""
    places = ["--start", "1,1", "--goal", "6,4"]
    assert plan(run_dir, *places, "--out", out, *arguments) == 0
    return load(out / "plan.json"), load(out / "paths.geojson")["features"]


def mapped_polygon(run_dir) -> shapely.Polygon:
    """From the walls of map.geojson, by shapely."""
    features = load(run_dir / "map.geojson")["features"]
    walls = [shapely.geometry.shape(f["geometry"]) for f in features if f["properties"]["kind"] == "wall"]
    return max(shapely.get_parts(shapely.polygonize(walls)), key=lambda polygon: polygon.area)


def line_of(features: list[dict], name: str) -> np.ndarray:
    (found,) = (f for f in features if f["properties"]["kind"] == "path" and f["properties"]["name"] == name)
    return np.array(found["geometry"]["coordinates"])


def test_shortest_is_as_short_as_brute_force(finished, tmp_path):
    told, features = planned(finished, tmp_path / "plan", "--figures", "none")
    polygon = mapped_polygon(finished)
    line = shapely.LineString(line_of(features, "shortest"))
    assert line.coords[0] == START and line.coords[-1] == GOAL
    assert line.length == pytest.approx(VisibilityGraph(polygon).length_m(START, GOAL), abs=1e-9)
    assert told["paths"]["shortest"]["length_m"] == pytest.approx(line.length, abs=1e-12)
    assert line.difference(polygon).length < 1e-9 and told["paths"]["shortest"]["clearance_m"] < 1e-9
    assert not (tmp_path / "plan" / "paths.png").exists()


def test_a_path_that_grazes_walls_is_said_to(finished, tmp_path, capsys):
    """The shortest path bends around corners; its clearance of zero is no negative number."""
    for radius, said in ((0, "; a radius gives"), (0.1, "; a radius larger than 0.1 m gives")):
        out = tmp_path / str(radius)
        planned(finished, out, "--figures", "none", "--objective", "shortest,widest", "--robot-radius", radius)
        printed = " ".join(capsys.readouterr().out.split())
        assert f"shortest: about even odds to touch wherever a wall is grazed{said} room to err" in printed
        assert "-0.000" not in printed
        touches = load(out / "plan.json")["paths"]["shortest"]["touching_probability"]
        assert 0.2 < touches < 0.9  # a quarter of a turn is wall, and there is a corner or two


def test_covariance_along_the_path(finished, tmp_path):
    """Stations stand on the path, in order; their covariances grow on odometry, and end as the summary says."""
    told, features = planned(finished, tmp_path / "plan", "--figures", "none", "--model", "odometry")
    line = shapely.LineString(line_of(features, "shortest"))
    stations = [f for f in features if f["properties"]["kind"] == "station"]
    along = [f["properties"]["distance_m"] for f in stations]
    assert along[0] == 0.0 and along[-1] == pytest.approx(line.length) and (np.diff(along) > 0).all()
    for station, distance_m in zip(stations, along, strict=True):
        expected = line.interpolate(distance_m)
        assert station["geometry"]["coordinates"] == pytest.approx([expected.x, expected.y], abs=1e-6)
        position, pose = (np.array(station["properties"][key]) for key in ("covariance", "pose_covariance"))
        assert np.linalg.eigvalsh(pose)[0] > -1e-12 and np.array_equal(pose[:2, :2], position)
    traces = [np.trace(f["properties"]["covariance"]) for f in stations]
    assert traces[-1] > 10 * traces[0] and max(traces) == pytest.approx(traces[-1], rel=0.2)
    assert told["paths"]["shortest"]["final_sigma_m"] == pytest.approx(np.sqrt(traces[-1]))


def test_what_each_objective_is_best_at(finished, tmp_path):
    told, features = planned(
        finished, tmp_path / "plan", "--objective", "all", "--model", "corners", "--robot-radius", 0.1
    )
    paths, walls = told["paths"], mapped_polygon(finished).boundary
    assert list(paths)[:4] == ["shortest", "safest", "widest", "pareto 1"]
    for name, path in paths.items():
        line = shapely.LineString(line_of(features, name))
        assert path["length_m"] == pytest.approx(line.length) and line.coords[0] == START and line.coords[-1] == GOAL
        assert path["clearance_m"] == pytest.approx(walls.distance(line) - 0.1, abs=1e-9)
        assert 0 <= path["touching_probability"] <= 1
    assert paths["shortest"]["length_m"] == min(path["length_m"] for path in paths.values())
    assert paths["widest"]["clearance_m"] >= max(path["clearance_m"] for path in paths.values()) - 2e-3
    assert paths["safest"]["final_sigma_m"] <= 1.01 * min(path["final_sigma_m"] for path in paths.values())
    front = [path for name, path in paths.items() if name.startswith("pareto")]
    assert (np.diff([path["length_m"] for path in front]) > 0).all()
    assert (np.diff([path["final_sigma_m"] for path in front]) < 0).all()
    picture = (tmp_path / "plan" / "paths.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 20_000


def test_the_same_question_gets_the_same_answer_in_a_new_directory(finished, capsys):
    places = ("--start", "1,1", "--goal", "6,4", "--figures", "none")
    assert [plan(finished, *places), plan(finished, *places)] == [0, 0]
    one, other = sorted((finished / "plans").iterdir())
    assert (one / "plan.json").read_bytes() == (other / "plan.json").read_bytes()
    assert (one / "paths.geojson").read_bytes() == (other / "paths.geojson").read_bytes()
    assert "touches a wall" in capsys.readouterr().out


def test_negative_coordinates(finished, tmp_path):
    """Not taken for options."""
    west = min(x for x, _ in mapped_polygon(finished).exterior.coords)
    assert west < -0.2
    x = f"{west + 0.15:.3f}"
    assert plan(finished, "--start", f"{x},2.5", "--goal", f"{x},2.6", "--out", tmp_path / "plan") == 0
    assert load(tmp_path / "plan" / "plan.json")["paths"]["shortest"]["length_m"] == pytest.approx(0.1)


def test_a_place_to_itself(finished, tmp_path):
    assert plan(finished, "--start", "1,1", "--goal", "1,1", "--out", tmp_path / "plan") == 0
    paths = load(tmp_path / "plan" / "plan.json")["paths"]
    assert {path["length_m"] for path in paths.values()} == {0.0}


def test_a_robot_that_does_not_fit(finished, tmp_path, capsys):
    """The narrowest passage around the obstacle, and a robot a little wider: it fits at both ends, not in between."""
    polygon = mapped_polygon(finished)
    for radius_m in np.arange(0.3, 1.5, 0.02):
        left = shapely.get_parts(polygon.buffer(-radius_m))
        if len(left) > 1:
            break
    assert len(left) > 1
    a, b = (part.representative_point() for part in sorted(left, key=shapely.area)[-2:])
    places = ("--start", f"{a.x},{a.y}", "--goal", f"{b.x},{b.y}")
    assert plan(finished, *places, "--robot-radius", radius_m, "--out", tmp_path / "plan") == 3
    require_one_line(capsys.readouterr().err, "no path leads", "radius")
    assert load(tmp_path / "plan" / "plan.json")["outcome"] == "unreachable"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--start=-50,1", "--goal", "6,4"], ["start", "free space", "outside"]),
        (["--start", "1,1", "--goal", "3.2,2.8"], ["goal", "outside"]),  # in the obstacle
        (["--start", "1,1", "--goal", "nan,4"], ["--goal", "finite"]),
        (["--start", "1e999,1", "--goal", "6,4"], ["--start", "finite"]),
        (["--start", "1", "--goal", "6,4"], ["--start", "X,Y"]),
        (["--start", "1,1,1", "--goal", "6,4"], ["--start", "X,Y"]),
        (["--start", "1,1"], ["--goal"]),
        (["--start", "1,1", "--goal", "6,4", "--robot-radius", "-1"], ["--robot-radius"]),
        (["--start", "1,1", "--goal", "6,4", "--robot-radius", "1000"], ["robot_radius_m"]),
        (["--start", "1,1", "--goal", "6,4", "--robot-radius", "2.5"], ["start", "2.5 m from walls"]),
        (["--start", "1,1", "--goal", "6,4", "--objective", "fastest"], ["--objective", "fastest"]),
        (["--start", "1,1", "--goal", "6,4", "--model", "magic"], ["--model", "magic"]),
    ],
)
def test_one_line_for_what_is_wrong(finished, tmp_path, capsys, arguments, words):
    assert plan(finished, *arguments, "--out", tmp_path / "plan") == 2
    require_one_line(capsys.readouterr().err, *words)
    assert not (tmp_path / "plan").exists()


def test_an_older_plan_is_kept(finished, tmp_path, capsys):
    planned(finished, tmp_path / "plan", "--figures", "none")
    capsys.readouterr()
    arguments = [finished, "--start", "1,1", "--goal", "6,4", "--figures", "none", "--out"]
    for held in (tmp_path / "plan", finished, finished / "log.mcap"):
        assert plan(*arguments, held) == 2
        require_one_line(capsys.readouterr().err, "--out")
    assert plan(*arguments, tmp_path / "plan", "--force") == 0


def test_no_run_there(tmp_path, capsys):
    assert plan(tmp_path / "nothing", "--start", "1,1", "--goal", "6,4") == 2
    require_one_line(capsys.readouterr().err, "dual_graph.json")


def test_only_the_dual_graph_is_read(finished, tmp_path):
    shutil.copy(finished / "dual_graph.json", tmp_path)
    alone, _ = planned(tmp_path, tmp_path / "plan", "--figures", "none")
    whole, _ = planned(finished, tmp_path / "other", "--figures", "none")
    assert alone == whole


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.data())
def test_a_damaged_dual_graph(finished, tmp_path, capsys, data):
    """It is read, or one line says what is wrong with it; never a traceback."""
    content = data.draw(damaged((finished / "dual_graph.json").read_bytes()))
    (tmp_path / "dual_graph.json").write_bytes(content)
    places = ("--start", "1,1", "--goal", "6,4", "--figures", "none", "--out", tmp_path / "plan", "--force")
    code = plan(tmp_path, *places)
    said = capsys.readouterr().err
    assert code in (0, 2, 3)
    if code:
        require_one_line(said)


def test_a_run_that_did_not_finish(tmp_path):
    """Open gates bound the map; paths stay inside of it."""
    out = tmp_path / "run"
    (tmp_path / "c.toml").write_text("[budget]\nmoves = 14\n", encoding="utf-8")
    assert call("--world", "rooms_with_doors", "--config", tmp_path / "c.toml", "--out", out, "--figures", "none") in (
        0,
        3,
    )
    graph = nx.node_link_graph(json.loads((out / "dual_graph.json").read_text()), edges="edges")
    assert graph.graph["gates"] and len(graph) > 3
    ends = [f"{x!r},{y!r}" for x, y in (graph.nodes[t]["centroid"] for t in (0, max(graph)))]
    assert plan(out, "--start", ends[0], "--goal", ends[1], "--out", tmp_path / "plan") == 0
    places = {vertex["id"]: vertex["pose"][:2] for vertex in graph.graph["vertices"]}
    triangles = [shapely.Polygon([places[v] for v in vertices]) for _, vertices in graph.nodes(data="vertices")]
    line = shapely.LineString(line_of(load(tmp_path / "plan" / "paths.geojson")["features"], "shortest"))
    assert line.difference(shapely.union_all(triangles).buffer(1e-9)).is_empty
