"""The main job's command line: the files of a run, what is in them, and when they are left alone."""

import json
import subprocess
import sys
import tomllib

import gtsam
import networkx as nx
import numpy as np
import pytest
import shapely
from explore_script import FILES, ROBOTS, SQUARE, call, summary_of
from script_calls import SCRIPTS, files_of, load, require_one_line, without_seconds

from coopslam.io.run_log import read_run_log
from coopslam.io.tum import read_tum
from coopslam.records import CornerDecision, MoveNote, Odometry, TriangleDecision
from sim.world import load_world

SUMMARY = [
    *["world", "seed", "noise", "estimator", "outcome", "outcome_reason", "vertices", "holes", "triangles"],
    *["triangles_expected", "role_exchanges", "travel_m", "travel_over_perimeter", "mapped_area_m2", "true_area_m2"],
    *["robots", "strategy", "false_sightings", "true_triangulation"],
    *["covered_fraction", "overlap_fraction", "vertex_rmse_m", "vertex_nees_mean", "estimators", "total_seconds"],
]
SCORES = ["ate_rmse_m", "heading_rmse_rad", "causal_ate_rmse_m", "nees_mean", "crlb_ratio", "wall_seconds"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "one"
    assert call("--world", "paper_one_obstacle", "--seed", 7, "--figures", "none", "--out", out) == 0
    return out


def test_every_file_of_the_contract_is_there(finished):
    assert [name for name in FILES if not (finished / name).is_file() or not (finished / name).stat().st_size] == []


def test_the_summary_has_every_key(finished):
    summary = load(finished / "summary.json")
    assert [key for key in SUMMARY if key not in summary] == []
    assert (summary["world"], summary["seed"], summary["noise"]) == ("paper_one_obstacle", 7, "typical")
    assert (summary["outcome"], summary["estimator"]) == ("complete", "incremental")
    assert (summary["robots"], summary["strategy"]) == (list(ROBOTS), "nearest")
    assert summary["false_sightings"] == {"outliers": 0.0, "dropouts": 0.0} and summary["true_triangulation"] is True
    assert summary["triangles"] == summary["triangles_expected"] == summary["vertices"] + 2 * summary["holes"] - 2 == 13
    assert summary["covered_fraction"] >= 1 - 1e-6 and summary["overlap_fraction"] <= 1e-6
    assert summary["true_area_m2"] == pytest.approx(load_world("paper_one_obstacle").area_m2)
    assert summary["mapped_area_m2"] == pytest.approx(summary["true_area_m2"], rel=0.05)
    assert set(summary["travel_m"]) == set(ROBOTS)
    assert {"incremental", "batch", "dead-reckoning"} <= set(summary["estimators"])
    assert all(set(SCORES) <= set(scores) for scores in summary["estimators"].values())
    batch, reckoned = summary["estimators"]["batch"], summary["estimators"]["dead-reckoning"]
    assert batch["ate_rmse_m"] < reckoned["ate_rmse_m"]


def test_the_log_reads_back(finished):
    header, records = read_run_log(finished / "log.mcap")
    assert (header.robots, header.seed, header.world) == (ROBOTS, 7, "paper_one_obstacle")
    assert {Odometry, CornerDecision, TriangleDecision, MoveNote} <= {type(record) for record in records}
    summary = load(finished / "summary.json")
    assert sum(isinstance(record, TriangleDecision) for record in records) == summary["triangles"]
    moves = [record for record in records if isinstance(record, MoveNote)]
    assert sum(a.robot != b.robot for a, b in zip(moves, moves[1:], strict=False)) == summary["role_exchanges"]


def test_trajectories_read_back_and_are_near_the_truth(finished):
    tracks = []
    for robot in ROBOTS:
        stamps, poses = read_tum(finished / "trajectories" / f"{robot}.tum")
        causal_stamps, causal = read_tum(finished / "trajectories" / f"{robot}.causal.tum")
        true_stamps, true = read_tum(finished / "truth" / f"{robot}.tum")
        assert len(poses) == len(causal) > 10 and (stamps == causal_stamps).all() and (np.diff(stamps) > 0).all()
        tracks.append((stamps, poses, true_stamps, true))
    origin = tracks[0][3][0]
    assert tracks[0][1][0].equals(gtsam.Pose2(), 1e-6)
    for _, poses, _, true in tracks:
        assert (origin * poses[-1]).range(true[-1].translation()) < 0.5


def test_the_map_reads_back(finished):
    features = load(finished / "map.geojson")["features"]
    kinds = {
        kind: [f for f in features if f["properties"]["kind"] == kind]
        for kind in ("vertex", "triangle", "wall", "gate")
    }
    assert sum(map(len, kinds.values())) == len(features)
    assert [len(kinds[kind]) for kind in kinds] == [13, 13, 13, 0]
    world = load_world("paper_one_obstacle")
    places = {f["properties"]["id"]: f["geometry"]["coordinates"] for f in kinds["vertex"]}
    of_corner = {int(v): world.flat_index(*where) for v, where in load(finished / "truth" / "vertices.json").items()}
    assert sorted(of_corner.values()) == list(range(13)) and set(of_corner) == set(places)
    for f in kinds["vertex"]:
        cov = np.array(f["properties"]["covariance"])
        assert cov.shape == (2, 2) and (np.linalg.eigvalsh(cov) >= 0).all()
        assert f["properties"]["convex"] is bool(world.interior_angle(of_corner[f["properties"]["id"]]) < np.pi)
    for f in kinds["triangle"]:
        ring = f["geometry"]["coordinates"][0]
        assert ring == [places[v] for v in (*f["properties"]["vertices"], f["properties"]["vertices"][0])]
        assert shapely.is_ccw(shapely.linearrings(ring))
    for f in kinds["wall"]:
        a, b = f["properties"]["vertices"]
        assert f["geometry"]["coordinates"] == [places[a], places[b]] and world.next_index[of_corner[a]] == of_corner[b]
    assert load_world(finished / "truth" / "world.geojson").points.tolist() == world.points.tolist()


def test_the_dual_graph_reads_back(finished):
    graph = nx.node_link_graph(load(finished / "dual_graph.json"), edges="edges")
    assert graph.number_of_nodes() == 13 and graph.number_of_edges() == 13  # one obstacle: one loop
    for _, node in graph.nodes(data=True):
        assert {"vertices", "centroid", "area_m2", "position_covariance", "position_sigma_m"} <= set(node)
        worst = np.linalg.eigvalsh(np.array(node["position_covariance"]))[-1]
        assert node["position_sigma_m"] == pytest.approx(np.sqrt(worst))
    for _, _, edge in graph.edges(data=True):
        keys = {"gate", "width_m", "width_sigma_m", "length_m", "relative_sigma_m", "odometry_sigma_per_m"}
        assert keys <= set(edge) and len(edge["gate"]) == 2


def test_gtsam_reads_the_pose_graph(finished):
    graph, values = gtsam.readG2o(str(finished / "pose_graph.g2o"), False)
    keys = load(finished / "pose_graph.keys.json")
    assert values.size() == len(keys) and graph.size() > 100
    kinds = [entry["kind"] for entry in keys.values()]
    assert kinds.count("vertex") == 13 and kinds.count("pose") == len(kinds) - 13
    assert graph.error(values) < 2 * graph.size()  # a solved graph


def test_the_config_gives_the_same_run_again(finished, tmp_path):
    config = tomllib.loads((finished / "config.toml").read_text(encoding="utf-8"))
    assert (config["seed"], config["world"]) == (7, "paper_one_obstacle")
    assert config["true_noise"]["odometry"]["translation_sigma_m"] == 0.03
    assert call("--config", finished / "config.toml", "--out", tmp_path / "again") == 0
    assert without_seconds(load(tmp_path / "again" / "summary.json")) == without_seconds(
        load(finished / "summary.json")
    )


def test_the_seed_decides_the_summary(finished, tmp_path):
    arguments = ("--world", "paper_one_obstacle", "--figures", "none", "--out")
    for name, seed in (("same", 7), ("other", 8)):
        assert call("--seed", seed, *arguments, tmp_path / name) == 0
    first, same, other = (
        without_seconds(load(out / "summary.json")) for out in (finished, tmp_path / "same", tmp_path / "other")
    )
    assert same == first
    assert (
        other["estimators"]["batch"] != first["estimators"]["batch"]
        and other["vertex_rmse_m"] != first["vertex_rmse_m"]
    )
    for name in ("map.geojson", "dual_graph.json", "pose_graph.g2o", "trajectories/robot1.tum"):
        assert (tmp_path / "same" / name).read_bytes() == (finished / name).read_bytes()


def test_without_noise_and_by_batch(tmp_path):
    arguments = ("--world", "paper_two_occluders", "--figures", "none", "--noise", "none")
    assert call(*arguments, "--estimator", "batch", "--out", tmp_path / "run") == 0
    summary = load(tmp_path / "run" / "summary.json")
    assert (summary["noise"], summary["estimator"], summary["outcome"]) == ("none", "batch", "complete")
    assert summary["vertex_rmse_m"] < 1e-4


def test_an_existing_run_is_kept_unless_forced(finished, tmp_path, capsys):
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    assert call("--figures", "none", "--out", finished) == 2
    require_one_line(capsys.readouterr().err, str(finished), "--force")
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before
    arguments = ("--world", "paper_two_occluders", "--figures", "none", "--out", tmp_path / "run")
    assert call("--seed", 1, *arguments) == 0
    assert call("--seed", 2, *arguments) == 2
    assert load(tmp_path / "run" / "summary.json")["seed"] == 1
    assert call("--seed", 2, *arguments, "--force") == 0
    assert load(tmp_path / "run" / "summary.json")["seed"] == 2


def test_out_must_be_a_directory(tmp_path, capsys):
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        assert call("--figures", "none", "--out", out) == 2
        require_one_line(capsys.readouterr().err, str(out))
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_wrong_settings_do_not_cost_an_old_run(finished, capsys):
    before = files_of(finished)
    for name, content in (
        ("start_corner", "[team]\nstart_corner = 99"),
        ("heading_sigma_rad", "[believed_noise.tracker]\nheading_sigma_rad = 0.0"),
    ):
        config = finished.parent / f"{name}.toml"
        config.write_text(content, encoding="utf-8")
        assert call("--config", config, "--out", finished, "--force") == 2
        require_one_line(capsys.readouterr().err, name)
    assert call("--world", "nowhere", "--out", finished, "--force") == 2
    assert files_of(finished) == before


def test_an_empty_or_endless_out_is_bad_input(capsys):
    for out in ("", " ", "x" * 5000):
        assert call("--out", out) == 2
        require_one_line(capsys.readouterr().err, "--out")


@pytest.mark.parametrize(
    ("name", "folder"), [("../../evil", "_.._evil"), ("a b/ü", "a_b_"), ("w" * 500, "w" * 60), ("...", "world")]
)
def test_the_name_of_a_world_is_no_path(name, folder, tmp_path, monkeypatch):
    world = {"type": "Feature", "properties": {"name": name}, "geometry": {"type": "Polygon", "coordinates": [SQUARE]}}
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "w.geojson").write_text(json.dumps(world), encoding="utf-8")
    monkeypatch.chdir(tmp_path / "here")
    assert call("--world", "w.geojson", "--figures", "none") == 0
    (out,) = (tmp_path / "here" / "runs").iterdir()
    assert out.name == f"{folder}-typical-0" and sorted(p.name for p in tmp_path.iterdir()) == ["here"]
    monkeypatch.chdir(tmp_path)
    assert call("--config", out / "config.toml", "--out", tmp_path / "again") == 0
    assert summary_of(tmp_path / "again") == summary_of(out)


def test_the_animation_shows_what_the_report_shows(tmp_path, monkeypatch):
    made, shown, original = [], [], sys.modules["_exploration"].view_of

    def view_of(run):
        made.append(original(run))
        return made[-1]

    monkeypatch.setattr("_exploration.view_of", view_of)
    monkeypatch.setattr("explore_and_optimize.write_animation", lambda view, *_: shown.append(view) or [])
    assert call("--max-moves", 1, "--figures", "all", "--out", tmp_path / "run") == 3
    assert len(made) == 1 and shown[0] is made[0]


def test_end_to_end_in_a_process_of_its_own(tmp_path):
    """From another directory, figures included, as a user calls it."""
    command = [
        sys.executable,
        str(SCRIPTS / "explore_and_optimize.py"),
        "--world",
        "paper_two_occluders",
        "--seed",
        "3",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "complete" in done.stdout
    out = tmp_path / "runs" / "paper_two_occluders-typical-3"
    assert [name for name in FILES if not (out / name).is_file()] == []
    assert list((out / "figures").glob("*.svg")) or list((out / "figures").glob("*.png"))
    wrong = subprocess.run([*command, "--noise", "loud"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert wrong.returncode == 2 and wrong.stdout == ""
    require_one_line(wrong.stderr, "loud")
