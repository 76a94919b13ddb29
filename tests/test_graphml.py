"""GraphML, read back by networkx and by a plain XML parser."""

import json
import xml.etree.ElementTree as ET

import networkx as nx

from coopslam.io.graphml import write_graphml

NAMESPACE = {"g": "http://graphml.graphdrawing.org/xmlns"}


def example() -> nx.Graph:
    graph = nx.Graph(vertices=[{"id": 0}], joint=None, name="a & b <c>")
    graph.add_node(0, vertices=[0, 1, 2], centroid=[0.1, -2.5], cov=[[1.0, 0.25], [0.25, 2.0]], area_m2=0.5)
    graph.add_node(7, vertices=[0, 1, 3], centroid=[1e-17, 3.0], cov=[[4.0, 0.0], [0.0, 9.0]], area_m2=2, inverted=True)
    graph.add_edge(0, 7, gate=[0, 1], width_m=1 / 3, ragged=[[1], [2, 3]])
    return graph


def test_networkx_reads_it_back(tmp_path):
    write_graphml(tmp_path / "g.graphml", example())
    back = nx.read_graphml(tmp_path / "g.graphml", node_type=int)
    assert set(back) == {0, 7} and set(map(frozenset, back.edges)) == {frozenset((0, 7))} and not back.is_directed()
    node = back.nodes[7]
    assert (node["centroid_x"], node["centroid_y"]) == (1e-17, 3.0)  # to the last bit
    assert (node["cov_xx"], node["cov_xy"], node["cov_yy"]) == (4.0, 0.0, 9.0)
    assert json.loads(node["vertices"]) == [0, 1, 3] and node["inverted"] is True and node["area_m2"] == 2
    edge = back.edges[0, 7]
    assert (
        edge["width_m"] == 1 / 3 and json.loads(edge["gate"]) == [0, 1] and json.loads(edge["ragged"]) == [[1], [2, 3]]
    )
    assert json.loads(back.graph["vertices"]) == [{"id": 0}] and "joint" not in back.graph


def test_it_is_graphml(tmp_path):
    """Every value has a declared key, and numbers are declared as such."""
    write_graphml(tmp_path / "g.graphml", example())
    root = ET.parse(tmp_path / "g.graphml").getroot()
    keys = {key.get("id"): key for key in root.findall("g:key", NAMESPACE)}
    data = root.findall(".//g:data", NAMESPACE)
    assert data and {item.get("key") for item in data} <= set(keys)
    declared = {(key.get("for"), key.get("attr.name"), key.get("attr.type")) for key in keys.values()}
    assert {("node", "centroid_x", "double"), ("edge", "width_m", "double"), ("node", "vertices", "string")} <= declared
    assert len(root.findall(".//g:node", NAMESPACE)) == 2 and len(root.findall(".//g:edge", NAMESPACE)) == 1
