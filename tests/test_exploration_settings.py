"""Settings of an exploration that cannot be: one line that names where they come from, and what was expected."""

import json
import tomllib

import pytest
from explore_script import SQUARE, call, summary_of
from script_calls import load, require_one_line

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
    "case.toml": '[team]\nrobots = ["Ann", "ann"]',
    "name.toml": f'[team]\nrobots = ["ann", "{100 * "x"}"]',
    "ring.toml": "[team]\nstart_ring = 2",
    "hole.toml": "[team]\nstart_ring = 1\nstart_corner = 5",
    "long.toml": "seed = 99999999999999999999",
    "false.toml": "[false_sightings]\noutliers = 0.6",
    "world.toml": 'world = "nowhere"',
}
SAID = {
    "key.toml": "unknown key 'sed'",
    "nested.toml": "[team] unknown key 'speed'",
    "type.toml": "seed: expected integer",
    "bool.toml": "team.speed_m_per_s: expected number",
    "speed.toml": "team.speed_m_per_s: 0.001 to 10000 expected, got -1.0",
    "sigma.toml": "true_noise.odometry.translation_sigma_m: ",
    "doubt.toml": "believed_noise.tracker.heading_sigma_rad: ",
    "huge.toml": "true_noise.odometry.translation_sigma_m: ",
    "threshold.toml": "incremental.relinearize_threshold: ",
    "rounds.toml": "incremental.rounds: ",
    "robots.toml": "team.robots: ",
    "case.toml": "team.robots: names that differ in more than case expected, got Ann, ann",
    "name.toml": "team.robots: names of up to 40 letters, digits, - and _ expected, got '" + 56 * "x" + "...",
    "ring.toml": "team.start_ring: 0 to 1 in this world expected, got 2",
    "start.toml": "team.start_corner: 0 to 7 in this ring expected, got 99",
    "hole.toml": "team.start_corner: 0 to 4 in this ring expected, got 5",
    "seed.toml": "seed: zero or more expected, at most 2^63 - 1, got -1",
    "long.toml": "seed: expected integer of 64 bits, got 99999999999999999999",
    "false.toml": "false_sightings.outliers: 0 to 0.5 expected, got 0.6",
    "world.toml": "world: no world 'nowhere'",
}
BAD_ARGUMENTS = [
    (["--world", "nowhere"], "--world: no world 'nowhere'"),
    (["--config", "{dir}/fine.toml", "--world", "nowhere"], "--world: no world 'nowhere'"),
    (["--world", "missing.geojson"], "missing.geojson"),
    *[(["--world", f"{{dir}}/{name}"], name) for name in BAD_WORLDS],
    (["--world", "{dir}"], ""),
    (["--config", "missing.toml"], "missing.toml"),
    (["--config", "{dir}"], ""),
    *[(["--config", f"{{dir}}/{name}"], f"{name}: {SAID.get(name, '')}") for name in BAD_CONFIGS],
    (["--wrold", "x"], "--wrold"),
    (["surplus"], "surplus"),
    (["--noise", "loud"], "loud"),
    (["--estimator", "magic"], "magic"),
    (["--figures", "some"], "some"),
    (["--seed", "x"], "--seed"),
    (["--seed", "1.5"], "--seed"),
    (["--seed", "-1"], "--seed: a whole number from 0 to 2^63 - 1 expected, got -1"),
    (["--seed", "9" * 100], "got " + 57 * "9" + "... "),
    (["--seed", "9" * 5000], "--seed"),
    (["--seed"], "--seed"),
    (["--outliers", "0.6"], "--outliers: 0 to 0.5 expected, got 0.6"),
    (["--outliers", "some"], "--outliers: 0 to 0.5 expected, got 'some'"),
    (["--dropouts", "-0.1"], "--dropouts: 0 to 0.5 expected, got -0.1"),
    (["--robots", "9"], "--robots: 2 to 6 expected, got 9"),
    (["--max-moves", "0"], "--max-moves: a whole number from 1 to 2^63 - 1 expected, got 0"),
    (["--max-moves", "-5"], "got -5"),
    (["--max-travel", "0"], "--max-travel: more than zero and finite expected, got 0.0"),
    (["--max-travel", "nan"], "got nan"),
    (["--max-travel", "inf"], "got inf"),
    (["--max-travel", "far"], "got 'far'"),
]


@pytest.mark.parametrize(
    ("arguments", "word"), BAD_ARGUMENTS, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, word, tmp_path, capsys):
    for name, content in {"fine.toml": "seed = 3", **BAD_WORLDS, **BAD_CONFIGS}.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    arguments = [argument.format(dir=tmp_path) for argument in arguments]
    out = tmp_path / "out"
    assert call("--figures", "none", *arguments, "--out", out) == 2
    require_one_line(capsys.readouterr().err, word)
    assert not (out / "summary.json").exists()


def test_a_bad_config_names_file_and_key(tmp_path, capsys):
    for name, content, words in (
        ("a.toml", "[team]\nspeed = 3", ["team", "'speed'", "speed_m_per_s"]),
        (
            "b.toml",
            '[explorer.recognition]\nangle_sigmas = "x"',
            ["explorer.recognition.angle_sigmas: expected number, got 'x'"],
        ),
    ):
        (tmp_path / name).write_text(content, encoding="utf-8")
        assert call("--config", tmp_path / name, "--out", tmp_path / "out") == 2
        require_one_line(capsys.readouterr().err, name, *words)


def test_a_given_preset_wins_over_the_tables_of_a_config(tmp_path):
    (tmp_path / "c.toml").write_text("[true_noise.odometry]\ndrift_sigma_rad = 0.2", encoding="utf-8")
    arguments = ("--config", tmp_path / "c.toml", "--max-moves", 2, "--figures", "none", "--out")
    assert call(*arguments, tmp_path / "custom") == call("--noise", "none", *arguments, tmp_path / "none") == 3
    assert summary_of(tmp_path / "custom")["noise"] == "custom" and summary_of(tmp_path / "none")["noise"] == "none"
    config = tomllib.loads((tmp_path / "none" / "config.toml").read_text(encoding="utf-8"))
    assert config["true_noise"]["odometry"]["drift_sigma_rad"] == 0


RANGES = {
    "gate.numerical_sigma": ("more than zero and at most 1000", [0.0, 1.1e3]),
    "explorer.recognition.crowd_radius_m": ("0.001 to 1000", [0.9e-3, 1.1e3]),
    "explorer.recognition.margin_log_odds": ("more than zero and at most 1e+06", [0.0, 1.1e6]),
    "explorer.recognition.search_radius_m": ("more than zero and at most 1e+06", [0.0, 1.1e6]),
    "explorer.chart.place_sigmas": ("more than zero and at most 1e+06", [0.0, 1.1e6]),
    "team.speed_m_per_s": ("0.001 to 10000", [0.9e-3, 1.1e4]),
    "team.turn_rate_rad_per_s": ("0.001 to 10000", [0.9e-3, 1.1e4]),
    "team.odometry_period_s": ("0.001 to 10000", [0.9e-3, 1.1e4]),
    "team.sighting_period_s": ("0.001 to 10000", [0.9e-3, 1.1e4]),
    "robust.iterations": ("1 to 1000", [0, 1001]),
    "robust.mu_factor": ("more than 1 and at most 100", [1.0, 101.0]),
    "robust.distance_sq_max": ("more than zero", [0.0]),
    "gate.distance_sq_max": ("more than zero", [0.0]),
}


@pytest.mark.parametrize("key", RANGES)
def test_a_number_out_of_range_is_refused_with_its_key_and_the_range(key, tmp_path, capsys):
    (table, name), (expected, numbers) = key.rsplit(".", 1), RANGES[key]
    for number in numbers:
        (tmp_path / "c.toml").write_text(f"[{table}]\n{name} = {number}", encoding="utf-8")
        assert call("--config", tmp_path / "c.toml", "--out", tmp_path / "out") == 2
        require_one_line(capsys.readouterr().err, f"c.toml: {key}: {expected} expected, got {number}")


WIDEST = [
    "[gate]\nnumerical_sigma = 1e3",
    "[explorer.recognition]\ncrowd_radius_m = 1e-3",
    "[explorer.recognition]\ncrowd_radius_m = 1e3",
    "[team]\nspeed_m_per_s = 1e4\nturn_rate_rad_per_s = 1e4",
    "[team]\nodometry_period_s = 1e4\nsighting_period_s = 1e4",
    "[robust]\niterations = 1000\nmu_factor = 100",
]


@pytest.mark.parametrize("content", WIDEST)
def test_a_run_with_the_largest_settings_ends(content, tmp_path):
    (tmp_path / "c.toml").write_text(content, encoding="utf-8")
    arguments = ("--outliers", 0.1, "--max-moves", 9, "--figures", "none", "--out", tmp_path / "out")
    assert call("--config", tmp_path / "c.toml", *arguments) == 3
    assert load(tmp_path / "out" / "summary.json")["outcome"] in ("budget", "stuck")


def test_a_world_with_a_wrong_feature_is_refused(tmp_path, capsys):
    wrong = {"type": "Feature", "properties": {"kind": "slipery"}, "geometry": None}
    world = {"type": "FeatureCollection", "features": [{"type": "Polygon", "coordinates": [SQUARE]}, wrong]}
    (tmp_path / "w.geojson").write_text(json.dumps(world), encoding="utf-8")
    assert call("--world", tmp_path / "w.geojson", "--out", tmp_path / "out") == 2
    require_one_line(capsys.readouterr().err, "--world: ", "w.geojson: feature 1: ", 'kind must be "slippery"')
