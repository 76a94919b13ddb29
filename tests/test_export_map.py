"""export_map.py on a finished run: files that others read, and one line for what is wrong."""

import cv2
import networkx as nx
import numpy as np
import pytest
import shapely
from explore_script import SCRIPTS, call, load, require_one_line  # noqa: F401 puts the scripts on the path

from _cli import run  # isort: skip
from export_map import main  # isort: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "run"
    assert call("--world", "paper_one_obstacle", "--seed", 3, "--out", out, "--figures", "none") == 0
    return out


def export(*arguments) -> int:
    try:
        return run(main, [str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


def test_pgm_shows_the_mapped_free_space(finished, tmp_path):
    """Free area within one cell along the walls; a vertex of map.geojson lies where the picture says occupied."""
    assert export(finished, "--format", "pgm", "--resolution", 0.04, "--out", tmp_path) == 0
    pixels = cv2.imread(str(tmp_path / "map.pgm"), cv2.IMREAD_UNCHANGED)
    described = dict(line.split(": ") for line in (tmp_path / "map.yaml").read_text().splitlines())
    x0, y0, _ = (float(number) for number in described["origin"].strip("[]").split(","))
    assert float(described["resolution"]) == 0.04
    features = load(finished / "map.geojson")["features"]
    shapes = [shapely.geometry.shape(f["geometry"]) for f in features if f["properties"]["kind"] == "triangle"]
    perimeter_m = sum(
        shapely.geometry.shape(f["geometry"]).length for f in features if f["properties"]["kind"] == "wall"
    )
    free_m2, walls_m2 = ((pixels == value).sum() * 0.04**2 for value in (254, 0))
    area_m2 = shapely.union_all(shapes).area
    assert free_m2 < area_m2 < free_m2 + walls_m2 and walls_m2 < 2 * 0.04 * perimeter_m
    for feature in features:
        if feature["properties"]["kind"] == "vertex":
            x, y = feature["geometry"]["coordinates"]
            row, column = len(pixels) - 1 - int((y - y0) // 0.04), int((x - x0) // 0.04)
            assert (pixels[row - 1 : row + 2, column - 1 : column + 2] == 0).any()
    assert np.isin(pixels, (0, 205, 254)).all()


def test_graphml_is_the_dual_graph(finished, tmp_path):
    assert export(finished, "--format", "graphml", "--out", tmp_path) == 0
    back = nx.read_graphml(tmp_path / "dual_graph.graphml", node_type=int)
    data = load(finished / "dual_graph.json")
    original = nx.node_link_graph(data, edges="edges")
    assert set(back) == set(original) and nx.is_isomorphic(back, original)
    for node, attributes in original.nodes(data=True):
        assert [back.nodes[node]["centroid_x"], back.nodes[node]["centroid_y"]] == attributes["centroid"]
        assert back.nodes[node]["area_m2"] == attributes["area_m2"]
    for a, b, attributes in original.edges(data=True):
        assert back.edges[a, b]["width_m"] == attributes["width_m"]


def test_beside_the_run_and_not_over_older_files(finished, capsys):
    assert export(finished, "--format", "pgm") == 0
    assert {path.name for path in (finished / "exports").iterdir()} == {"map.pgm", "map.yaml"}
    capsys.readouterr()
    assert export(finished, "--format", "pgm") == 2
    require_one_line(capsys.readouterr().err, "map.pgm", "--force")
    assert export(finished, "--format", "pgm", "--force") == 0
    assert export(finished, "--format", "graphml") == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--format", "pgm", "--resolution", "0"], ["resolution_m", "more than zero"]),
        (["--format", "pgm", "--resolution", "nan"], ["resolution_m"]),
        (["--format", "pgm", "--resolution", "1e-9"], ["resolution_m", "cells"]),
        (["--format", "pgm", "--resolution", "wide"], ["--resolution", "wide"]),
        (["--format", "png"], ["--format", "png"]),
        ([], ["--format"]),
    ],
)
def test_one_line_for_what_is_wrong(finished, tmp_path, capsys, arguments, words):
    assert export(finished, *arguments, "--out", tmp_path / "out") == 2
    require_one_line(capsys.readouterr().err, *words)
    assert not (tmp_path / "out").exists()


def test_no_run_there(tmp_path, capsys):
    assert export(tmp_path / "nothing", "--format", "pgm") == 2
    require_one_line(capsys.readouterr().err, "dual_graph.json")
