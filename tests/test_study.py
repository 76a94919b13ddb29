"""Study files: what they may say, what the combinations become, and what identifies a run."""

import json
import subprocess
import sys
from dataclasses import replace
from math import radians
from pathlib import Path

import pytest
from _study import is_success, key_of, load_study
from script_calls import SCRIPTS

from coopslam.errors import BadInput
from coopslam.io.toml import from_mapping
from coopslam.report.study_panels import wilson
from sim.noise import LEGGED, PRESETS, TYPICAL
from sim.world import load_world, world_names

HEAD = 'name = "s"\nseeds = 2\nworlds = ["paper_one_obstacle"]\n'


def study(folder: Path, text: str, head: str = HEAD):
    path = folder / "s.toml"
    path.write_text(head + text, encoding="utf-8")
    return load_study(path)


def settings_of(run):
    from _exploration import ExplorationSettings

    return from_mapping(ExplorationSettings, run.settings, "run")


def test_the_full_product_with_seeds_outermost(tmp_path):
    head = HEAD.replace('"paper_one_obstacle"', '"paper_one_obstacle", "comb"')
    axes = '[axes]\nnoise = ["typical", "legged"]\n"team.speed_m_per_s" = [0.25, 0.5, 1]\n'
    runs = study(tmp_path, axes, head).runs
    assert len(runs) == len({run.key for run in runs}) == 2 * 2 * 2 * 3
    assert [run.seed for run in runs] == [0] * 12 + [1] * 12
    assert (runs[0].world.name, runs[1].world.name, runs[2].values) == ("paper_one_obstacle", "comb", (0, 1))
    assert settings_of(runs[-1]).team.speed_m_per_s == 1.0 and settings_of(runs[-1]).true_noise == LEGGED


def test_a_factor_scales_what_is_in_force(tmp_path):
    text = """
[[axes]]
setting = "noise"
values = ["typical", "legged"]
[[axes]]
name = "odometry"
scale = ["true_noise.odometry", "believed_noise.odometry.drift_sigma_rad"]
values = [0.5, 2]
"""
    for run in study(tmp_path, text).runs:
        settings, preset, factor = settings_of(run), (TYPICAL, LEGGED)[run.values[0]], (0.5, 2)[run.values[1]]
        odometry = preset.odometry
        assert settings.true_noise.odometry.translation_sigma_m == factor * odometry.translation_sigma_m
        assert settings.true_noise.odometry.floor_sigma == factor * odometry.floor_sigma
        assert settings.true_noise.tracker == preset.tracker
        believed = replace(odometry, drift_sigma_rad=factor * odometry.drift_sigma_rad)
        assert settings.believed_noise == replace(preset, odometry=believed)


def test_tables_change_several_settings(tmp_path):
    text = """
[base]
noise = "legged"
[[axes]]
name = "odometry"
values = [
    {label = "as is", budget.moves = 50},
    {label = "x2", at = 2, "true_noise.odometry.drift_sigma_rad" = 0.2, believed_noise.odometry.drift_sigma_rad = 0.3},
]
"""
    found = study(tmp_path, text)
    (axis,) = found.axes
    assert [(value.label, value.at) for value in axis.values] == [("as is", None), ("x2", 2.0)]
    as_is, twice = settings_of(found.runs[0]), settings_of(found.runs[1])
    assert (as_is.budget.moves, as_is.true_noise) == (50, LEGGED)
    assert twice.true_noise.odometry == replace(LEGGED.odometry, drift_sigma_rad=0.2)
    assert twice.believed_noise.odometry.drift_sigma_rad == 0.3
    assert twice.true_noise.odometry.rotation_sigma_rad == radians(20)


TWO_LABELS = """
[[axes]]
name = "a"
values = [{label = "one two", budget.moves = 3}, {label = " one\t two ", budget.moves = 4}]
"""
BAD = [
    ("sedes = 3", ["'sedes'", "known keys", "worlds"]),
    ("[base]\nsped = 3", ["[base]", "'sped'", "known keys", "budget"]),
    ("[base]\nseed = 3", ["[base] seed", "'seeds'"]),
    ("[base]\n[base.team]\nstart_corner = 99", ["start_corner"]),
    ('[axes]\n"true_noise.odometry.translation" = [1]', ["'translation'", "translation_sigma_m"]),
    ('[axes]\n"true_noise.wheel" = [1]', ["'wheel'", "odometry"]),
    ('[axes]\n"seed.x" = [1]', ["seed"]),
    ("[axes]\nseed = [1, 2]", ["'seeds'"]),
    ('[axes]\nnoise = ["loud"]', ["'loud'", "typical"]),
    ("[axes]\nnoise = []", ["noise", "at least one"]),
    ('[axes]\nnoise = "typical"', ["a list"]),
    ('[axes]\nnoise = ["none", "none"]', ["each one once"]),
    ('[axes]\n"true_noise.odometry.drift_sigma_rad" = [-1]', ["drift_sigma_rad = -1", "zero or more"]),
    ('[axes]\n"believed_noise.odometry.drift_sigma_rad" = [0.0]', ["believed_noise.odometry.drift_sigma_rad"]),
    ('[[axes]]\nsetting = "noise"', ["'values'"]),
    ('[[axes]]\nvalues = ["typical"]', ["'name'"]),
    ('[[axes]]\nname = "a"\nvalues = [1]', ["label"]),
    ('[[axes]]\nname = "a"\nvalues = [{noise = "typical"}]', ["'label'"]),
    ('[[axes]]\nname = "a"\nvalues = [{label = "b"}]', ["no setting"]),
    ('[[axes]]\nname = "a"\nscale = ["true_noise.wheel"]\nvalues = [1]', ["'wheel'", "odometry"]),
    ('[[axes]]\nname = "a"\nscale = ["true_noise"]\nvalues = [-1]', ["factor"]),
    ('[[axes]]\nname = "a"\nsettings = ["noise"]\nvalues = [1]', ["'settings'", "known keys"]),
    ('[axes]\nnoise = ["typical", "legged"]\n[base.true_noise]\n[base.believed_noise]', ["the same run"]),
    ('[axes]\nnoise = ["typical", " typical"]', ["each one once"]),
    (TWO_LABELS, ["each one once", "one two, one two"]),
    ('[[axes]]\nname = "a  b"\nsetting = "noise"\nvalues = ["none"]\n' * 2, ["noise is changed", "'a b' and 'a b'"]),
    ('[[axes]]\nname = "a"\nscale = ["budget.moves"]\nvalues = [1.5e-5]', ["moves counts", "whole"]),
    ('[[axes]]\nname = "a"\nscale = ["team"]\nvalues = [1.1]', ["scale: team", "no whole number"]),
    (f'[[axes]]\nname = "a"\nscale = ["budget.moves"]\nvalues = [{10**400}]', ["factor", "..."]),
    (f'[[axes]]\nname = "a"\nvalues = [{{label = "b", at = {10**400}, budget.moves = 3}}]', ["finite", "..."]),
]


@pytest.mark.parametrize(("text", "words"), BAD, ids=[text.replace("\n", " ") for text, _ in BAD])
def test_a_bad_study_is_said_with_file_and_key(text, words, tmp_path):
    with pytest.raises(BadInput) as caught:
        study(tmp_path, text)
    said = str(caught.value)
    assert "s.toml" in said and [word for word in words if word not in said] == [], said


@pytest.mark.parametrize(
    ("head", "word"),
    [
        ('name = "s"\nseeds = 2\n', "'worlds'"),
        ('name = "s"\nseeds = 2\nworlds = []\n', "at least one"),
        ('name = "s"\nseeds = 2\nworlds = ["nowhere"]\n', "nowhere"),
        ('name = "s"\nseeds = 2\nworlds = ["no/where.geojson"]\n', "where.geojson"),
        ('name = "s"\nseeds = 2\nworlds = ["comb", "comb"]\n', "comb"),
        *[
            (f'name = "s"\nworlds = ["comb"]\nseeds = {seeds}\n', "seeds")
            for seeds in ("0", "-1", "true", "[]", "[1.5]")
        ],
        ('name = "s"\nworlds = ["comb"]\nseeds = [3, 3]\n', "seeds"),
        ('name = "s"\nworlds = ["comb"]\nseeds = 100000000\n', "1000000 runs expected .*, got 100000000"),
        (f'name = "s"\nworlds = ["comb"]\nseeds = {10**400}\n', r"runs expected .*, got 10+\.\.\."),
        ('name = "s"\nworlds = ["comb", "pillars"]\nseeds = 600000\n', "got 1200000"),
    ],
)
def test_bad_worlds_and_seeds(head, word, tmp_path):
    with pytest.raises(BadInput, match=word):
        study(tmp_path, "", head)


def test_bad_values_are_quoted_in_part(tmp_path):
    long = "x" * 500
    for text in (
        f'axes = "{long}"',
        f'[[axes]]\nname = "a"\nvalues = ["{long}"]',
        f'[[axes]]\nname = "a"\nscale = ["{long}"]\nvalues = [2]',
        f'[[axes]]\nname = "{long}"\nscale = ["true_noise"]\nvalues = ["{long}"]',
        f'[axes]\n"noise.{long}" = [1]',
        f'[axes]\n"{long}" = [1, 1]',
    ):
        with pytest.raises(BadInput) as caught:
            study(tmp_path, text)
        said = str(caught.value).replace(str(tmp_path), "")
        assert "x" * 50 in said and "x" * 61 not in said, said
    with pytest.raises(BadInput, match=r"seeds: .*, got \['x{55}\.\.\.$"):
        study(tmp_path, "", f'name = "s"\nseeds = ["{long}"]\nworlds = ["comb"]\n')


def test_two_names_for_one_world_are_refused(tmp_path):
    (tmp_path / "mine.geojson").write_text(json.dumps(load_world("comb").to_geojson()), encoding="utf-8")
    with pytest.raises(BadInput, match=r"s\.toml: worlds 'comb' and 'mine' are the same"):
        study(tmp_path, "", 'name = "s"\nseeds = 2\nworlds = ["comb", "mine.geojson"]\n')


def test_a_count_scales_to_whole_numbers(tmp_path):
    text = '[[axes]]\nname = "a"\nscale = ["budget.moves"]\nvalues = [0.29, 2]'
    moves = [settings_of(run).budget.moves for run in study(tmp_path, text).runs[:2]]
    assert moves == [29_000, 200_000]
    text = '[base]\nbudget.moves = 100\n[[axes]]\nname = "a"\nscale = ["budget.moves"]\nvalues = [0.29]'
    assert 100 * 0.29 != 29  # in binary
    assert settings_of(study(tmp_path, text).runs[0]).budget.moves == 29


def test_names_and_labels_have_single_spaces(tmp_path):
    text = '[[axes]]\nname = " a\\n b "\nvalues = [{label = "x\\t y ", budget.moves = 3}]'
    (axis,) = study(tmp_path, text, HEAD.replace('"s"', '" my  study"')).axes
    assert (axis.name, axis.values[0].label) == ("a b", "x y")


def test_worlds_are_relative_to_the_study_and_known_by_content(tmp_path):
    (tmp_path / "worlds").mkdir()
    own = tmp_path / "worlds" / "mine.geojson"
    own.write_text(json.dumps(load_world("comb").to_geojson()), encoding="utf-8")
    found = study(tmp_path, "", HEAD.replace("paper_one_obstacle", "worlds/mine.geojson"))
    named = study(tmp_path, "", HEAD.replace("paper_one_obstacle", "comb"))
    assert found.worlds[0].name == "mine" and [r.key for r in found.runs] == [r.key for r in named.runs]
    (tmp_path / "elsewhere").mkdir()
    again = study(tmp_path / "elsewhere", found.text, "")
    assert [r.key for r in again.runs] == [r.key for r in found.runs]


def test_keys_are_the_same_in_another_process_and_differ_by_everything_that_matters(tmp_path):
    runs = study(tmp_path, '[axes]\nnoise = ["typical", "legged"]').runs
    script = "import sys; sys.path[:0] = sys.argv[2:]\nfrom _study import load_study\n"
    script += "print(*(run.key for run in load_study(sys.argv[1]).runs))"
    command = [sys.executable, "-c", script, str(tmp_path / "s.toml"), str(SCRIPTS), str(SCRIPTS.parent)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    assert printed.split() == [run.key for run in runs]
    settings, digest = settings_of(runs[0]), runs[0].world.digest
    assert key_of(settings, digest) == runs[0].key
    assert key_of(replace(settings, world="x", figures="all"), digest) == runs[0].key
    changed = [replace(settings, seed=9), replace(settings, estimator="batch"), replace(settings, true_noise=LEGGED)]
    assert len({runs[0].key, key_of(settings, "other"), *(key_of(each, digest) for each in changed)}) == 5


def test_the_ready_studies_can_be_prepared():
    paths = sorted((SCRIPTS / "studies").glob("*.toml"))
    runs = {path.stem: len(load_study(path).runs) for path in paths}
    assert runs["thousand_runs"] == 1000
    assert {"odometry_noise", "tracker_noise", "world_complexity"} <= set(runs)
    complexity = load_study(SCRIPTS / "studies" / "world_complexity.toml")
    assert {world.name for world in complexity.worlds} <= set(world_names()) and len(complexity.worlds) >= 10
    assert set(PRESETS) >= {"typical", "legged"}


@pytest.mark.parametrize(
    ("successes", "runs", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_as_published(successes, runs, low, high):
    """Newcombe (1998), Statistics in Medicine 17, table I, method 3."""
    assert wilson(successes, runs) == pytest.approx((low, high), abs=5e-5)


def test_success_wants_a_true_triangulation():
    good = {"outcome": "complete", "true_triangulation": True, "triangles": 13, "triangles_expected": 13}
    good |= {"covered_fraction": 1.0, "overlap_fraction": 0.0}
    assert is_success(good)
    for wrong in ({"outcome": "stuck"}, {"triangles": 12}, {"covered_fraction": 0.99}, {"true_triangulation": False}):
        assert not is_success(good | wrong)
    assert not is_success({"outcome": "complete"})
