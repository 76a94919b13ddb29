"""The main job's command line: files, exit codes, one line for what the user can mend."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import gtsam
import networkx as nx
import numpy as np
import pytest
import shapely

SCRIPTS = Path(__file__).parents[1] / "scripts"
sys.path.insert(0, str(SCRIPTS))

import _exploration  # noqa: E402
from _cli import run  # noqa: E402
from explore_and_optimize import main  # noqa: E402

from coopslam.errors import UnderDetermined  # noqa: E402
from coopslam.io.run_log import read_run_log  # noqa: E402
from coopslam.io.tum import read_tum  # noqa: E402
from coopslam.records import CornerDecision, MoveNote, Odometry, TriangleDecision  # noqa: E402
from sim.world import load_world  # noqa: E402

ROBOTS = ("robot0", "robot1")
FILES = [
    "config.toml",
    "log.mcap",
    *[f"trajectories/{robot}{causal}.tum" for robot in ROBOTS for causal in ("", ".causal")],
    "map.geojson",
    "dual_graph.json",
    "pose_graph.g2o",
    "pose_graph.keys.json",
    "summary.json",
    "report.html",
    "truth/world.geojson",
    "truth/vertices.json",
    *[f"truth/{robot}.tum" for robot in ROBOTS],
]
SUMMARY = [
    *["world", "seed", "noise", "estimator", "outcome", "outcome_reason", "vertices", "holes", "triangles"],
    *["triangles_expected", "role_exchanges", "travel_m", "travel_over_perimeter", "mapped_area_m2", "true_area_m2"],
    *["covered_fraction", "overlap_fraction", "vertex_rmse_m", "vertex_nees_mean", "estimators", "total_seconds"],
]
SCORES = ["ate_rmse_m", "heading_rmse_rad", "causal_ate_rmse_m", "nees_mean", "crlb_ratio", "wall_seconds"]


def call(*arguments) -> int:
    """Exit code of the script in this process."""
    try:
        return run(main, [str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "one"
    assert call("--world", "paper_one_obstacle", "--seed", 7, "--figures", "none", "--out", out) == 0
    return out


def load(path: Path):
    return json.loads(path.read_text(encoding="utf-8"))


def without_seconds(value):
    if isinstance(value, dict):
        return {key: without_seconds(item) for key, item in value.items() if not key.endswith("_seconds")}
    return value


def files_of(out: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def summary_of(out: Path):
    """What does not depend on the clock."""
    return without_seconds(load(out / "summary.json"))


def test_every_file_of_the_contract_is_there(finished):
    assert [name for name in FILES if not (finished / name).is_file() or not (finished / name).stat().st_size] == []


def test_the_summary_has_every_key(finished):
    summary = load(finished / "summary.json")
    assert [key for key in SUMMARY if key not in summary] == []
    assert (summary["world"], summary["seed"], summary["noise"]) == ("paper_one_obstacle", 7, "typical")
    assert (summary["outcome"], summary["estimator"]) == ("complete", "incremental")
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


SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]
BAD_WORLDS = {
    "empty.geojson": "",
    "text.geojson": "a world",
    "point.geojson": '{"type": "Point", "coordinates": [0, 0]}',
    "list.geojson": "[1, 2, 3]",
    "bow.geojson": json.dumps({"type": "Polygon", "coordinates": [[[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]]]}),
    "short.geojson": json.dumps({"type": "Polygon", "coordinates": [[[0, 0], [4, 4], [0, 0]]]}),
    "nan.geojson": '{"type": "Polygon", "coordinates": [[[0, 0], [NaN, 0], [4, 4], [0, 0]]]}',
    "outside.geojson": json.dumps(
        {"type": "Polygon", "coordinates": [SQUARE, [[9, 9], [10, 9], [10, 10], [9, 10], [9, 9]]]}
    ),
    "two.geojson": json.dumps({"type": "MultiPolygon", "coordinates": [[SQUARE], [[[x + 9, y] for x, y in SQUARE]]]}),
    "binary.geojson": b"\xff\xfe\x00\x80",
}
BAD_CONFIGS = {
    "not.toml": "seed = ",
    "binary.toml": b"\xff\xfe\x00",
    "key.toml": "sed = 3",
    "nested.toml": "[team]\nspeed = 3",
    "type.toml": 'seed = "three"',
    "float.toml": "seed = 1.5",
    "bool.toml": "[team]\nspeed_m_per_s = true",
    "nan.toml": "[team]\nspeed_m_per_s = nan",
    "inf.toml": "[budget]\ntravel_m = inf",
    "choice.toml": 'noise = "loud"',
    "table.toml": "team = 4",
    "speed.toml": "[team]\nspeed_m_per_s = -1.0",
    "sigma.toml": "[true_noise.odometry]\ntranslation_sigma_m = -0.1",
    "doubt.toml": "[believed_noise.tracker]\nheading_sigma_rad = 0.0",
    "huge.toml": "[true_noise.odometry]\ntranslation_sigma_m = 1e200",
    "threshold.toml": "[incremental]\nrelinearize_threshold = 0.0",
    "rounds.toml": "[incremental]\nrounds = -1",
    "robots.toml": '[team]\nrobots = ["ann", "ann"]',
    "start.toml": "[team]\nstart_corner = 99",
    "seed.toml": "seed = -1",
    "budget.toml": "[budget]\nmoves = 0",
}
NAMED_KEY = {
    "start.toml": "start_corner",
    "doubt.toml": "believed_noise.tracker.heading_sigma_rad",
    "huge.toml": "translation_sigma_m",
    "threshold.toml": "relinearize_threshold",
    "rounds.toml": "rounds",
}
BAD_ARGUMENTS = [
    (["--world", "nowhere"], "nowhere"),
    (["--world", "missing.geojson"], "missing.geojson"),
    *[(["--world", f"{{dir}}/{name}"], name) for name in BAD_WORLDS],
    (["--world", "{dir}"], ""),
    (["--config", "missing.toml"], "missing.toml"),
    (["--config", "{dir}"], ""),
    *[(["--config", f"{{dir}}/{name}"], NAMED_KEY.get(name, "")) for name in BAD_CONFIGS],
    (["--wrold", "x"], "--wrold"),
    (["surplus"], "surplus"),
    (["--noise", "loud"], "loud"),
    (["--estimator", "magic"], "magic"),
    (["--figures", "some"], "some"),
    (["--seed", "x"], "--seed"),
    (["--seed", "1.5"], "--seed"),
    (["--seed", "-1"], "-1"),
    (["--seed"], "--seed"),
    (["--max-moves", "0"], "0 moves"),
    (["--max-moves", "-5"], "-5"),
    (["--max-travel", "0"], "0 m"),
    (["--max-travel", "nan"], "nan"),
    (["--max-travel", "inf"], "inf"),
    (["--max-travel", "far"], "far"),
]


@pytest.mark.parametrize(
    ("arguments", "word"), BAD_ARGUMENTS, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, word, tmp_path, capsys):
    for name, content in {**BAD_WORLDS, **BAD_CONFIGS}.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    arguments = [argument.format(dir=tmp_path) for argument in arguments]
    out = tmp_path / "out"
    assert call("--figures", "none", *arguments, "--out", out) == 2
    require_one_line(capsys.readouterr().err, word)
    assert not (out / "summary.json").exists()


def require_one_line(said: str, *words: str) -> None:
    assert said.endswith("\n") and len(said.splitlines()) == 1, said
    assert "Traceback" not in said and [word for word in words if word not in said] == [], said


def test_a_bad_config_names_file_and_key(tmp_path, capsys):
    for name, content, words in (
        ("a.toml", "[team]\nspeed = 3", ["team", "'speed'", "speed_m_per_s"]),
        ("b.toml", '[explorer.recognition]\nangle_sigmas = "x"', ["explorer.recognition", "angle_sigmas", "'x'"]),
    ):
        (tmp_path / name).write_text(content, encoding="utf-8")
        assert call("--config", tmp_path / name, "--out", tmp_path / "out") == 2
        require_one_line(capsys.readouterr().err, name, *words)


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


@pytest.mark.parametrize(("option", "value"), [("--max-moves", 1), ("--max-moves", 9), ("--max-travel", 12.5)])
def test_out_of_budget_is_exit_code_3_and_everything_is_written(option, value, tmp_path, capsys):
    out = tmp_path / "run"
    assert call("--figures", "none", "--out", out, option, value) == 3
    require_one_line(capsys.readouterr().err, "budget", f"{value:g}")
    assert [name for name in FILES if not (out / name).is_file()] == []
    summary = load(out / "summary.json")
    assert summary["outcome"] == "budget" and summary["triangles"] < summary["triangles_expected"]
    gates = [f for f in load(out / "map.geojson")["features"] if f["properties"]["kind"] == "gate"]
    assert gates and f"{len(gates)} gate" in summary["outcome_reason"]
    read_run_log(out / "log.mcap")
    nx.node_link_graph(load(out / "dual_graph.json"), edges="edges")


BARE = [
    *["world", "seed", "noise", "estimator", "outcome", "outcome_reason", "vertices", "holes", "triangles", "moves"],
    *["role_exchanges", "travel_m", "total_seconds"],
]


def test_a_robot_that_is_never_placed_leaves_a_run_behind(tmp_path, capsys):
    (tmp_path / "blind.toml").write_text("[team]\ntracker_blind_m = 50.0", encoding="utf-8")
    out = tmp_path / "run"
    assert call("--config", tmp_path / "blind.toml", "--out", out) == 3
    require_one_line(capsys.readouterr().err, "stuck", "robot1 has no place yet")
    summary = load(out / "summary.json")
    assert [key for key in BARE if key not in summary] == []
    assert summary["outcome"] == "stuck" and "robot1" in summary["outcome_reason"]
    assert "robot1" in summary["left_out"]["trajectories/robot1.tum"]
    assert (out / "trajectories" / "robot0.tum").is_file() and (out / "report.html").is_file()
    values = gtsam.readG2o(str(out / "pose_graph.g2o"), False)[1]
    assert values.size() == len(load(out / "pose_graph.keys.json"))
    read_run_log(out / "log.mcap")


@pytest.mark.parametrize("updates", [0, 7])
@pytest.mark.parametrize("estimator", ["incremental", "batch"])
def test_an_estimator_that_fails_leaves_a_run_behind(estimator, updates, tmp_path, capsys, monkeypatch):
    """From a certain update on its equations have no solution, for the batch solver neither."""
    driver, left = _exploration.DRIVERS[estimator], [updates]

    def fail(*arguments):
        raise UnderDetermined("no solution")

    def counted(self, records, update=driver.update):
        left[0] -= 1
        if left[0] < 0:
            monkeypatch.setattr("coopslam.estimation.incremental.Incremental._ask", fail)
            monkeypatch.setattr("coopslam.estimation.batch.solve_batch", fail)
            monkeypatch.setattr(_exploration, "solve_robust", fail)
        return update(self, records)

    monkeypatch.setattr(driver, "update", counted)
    out = tmp_path / "run"
    assert call("--estimator", estimator, "--out", out) == 3
    require_one_line(capsys.readouterr().err, "stuck", "no solution")
    summary = load(out / "summary.json")
    assert [key for key in BARE if key not in summary] == []
    assert summary["left_out"]["estimators.batch"] == "no solution" and (out / "report.html").is_file()
    assert (updates == 0) == (not (out / "trajectories" / "robot0.tum").is_file())


def test_an_estimate_that_contradicts_the_records_is_not_complete(tmp_path, capsys):
    """The robots believe that their trackers are fifty times as good as they are."""
    (tmp_path / "sure.toml").write_text(
        "[believed_noise.tracker]\nrange_sigma_m = 1e-4\nrange_sigma_per_m = 2e-4\nlateral_sigma_m = 1e-4\n"
        "bearing_sigma_rad = 7e-5\nheading_sigma_rad = 7e-4",
        encoding="utf-8",
    )
    out = tmp_path / "run"
    arguments = ("--config", tmp_path / "sure.toml", "--max-moves", 9, "--figures", "none", "--out", out)
    assert call(*arguments) == 3
    require_one_line(capsys.readouterr().err, "stuck")
    summary = load(out / "summary.json")
    assert summary["outcome"] == "stuck" and summary["noise"] == "custom"
    assert re.search(r"\d+ of \d+ sightings of robots by robots look false", summary["outcome_reason"])


def test_odometry_that_contradicts_everything_else_is_not_complete(tmp_path, capsys):
    """The robots believe that their odometry is a thousand times as good as it is."""
    (tmp_path / "sure.toml").write_text(
        "[believed_noise.odometry]\ntranslation_sigma_m = 3e-5\ndrift_sigma_rad = 3e-5\nrotation_sigma_rad = 5e-5\n"
        "[gate]\ndistance_sq_max = 1e9\n[robust]\ndistance_sq_max = 1e9",
        encoding="utf-8",
    )
    out = tmp_path / "run"
    arguments = ("--config", tmp_path / "sure.toml", "--max-moves", 9, "--figures", "none", "--out", out)
    assert call(*arguments) == 3
    require_one_line(capsys.readouterr().err, "stuck")
    assert "(chi-square per degree of freedom:" in load(out / "summary.json")["outcome_reason"]


def test_a_given_preset_wins_over_the_tables_of_a_config(tmp_path):
    (tmp_path / "c.toml").write_text("[true_noise.odometry]\ndrift_sigma_rad = 0.2", encoding="utf-8")
    arguments = ("--config", tmp_path / "c.toml", "--max-moves", 2, "--figures", "none", "--out")
    assert call(*arguments, tmp_path / "custom") == call("--noise", "none", *arguments, tmp_path / "none") == 3
    assert summary_of(tmp_path / "custom")["noise"] == "custom" and summary_of(tmp_path / "none")["noise"] == "none"
    config = tomllib.loads((tmp_path / "none" / "config.toml").read_text(encoding="utf-8"))
    assert config["true_noise"]["odometry"]["drift_sigma_rad"] == 0


def test_wrong_settings_do_not_cost_an_old_run(finished, capsys):
    before = files_of(finished)
    for name, content in (
        ("start_corner", BAD_CONFIGS["start.toml"]),
        ("heading_sigma_rad", BAD_CONFIGS["doubt.toml"]),
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


@pytest.mark.parametrize("table", ["true_noise", "believed_noise"])
def test_the_largest_sigmas_end_in_one_line(table, tmp_path, capsys):
    odometry = "translation_sigma_m = 1e3\ndrift_sigma_rad = 1e3\nrotation_sigma_rad = 1e3"
    (tmp_path / "c.toml").write_text(f"[{table}.odometry]\n{odometry}", encoding="utf-8")
    code = call("--config", tmp_path / "c.toml", "--max-moves", 20, "--figures", "none", "--out", tmp_path / "run")
    assert code == 3
    require_one_line(capsys.readouterr().err, "exploration")
    assert [key for key in BARE if key not in load(tmp_path / "run" / "summary.json")] == []


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
