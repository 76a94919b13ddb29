"""Graphs as GraphML, for yEd, Gephi, igraph and whoever reads attributes that are single numbers or texts."""

import json
from collections.abc import Mapping
from pathlib import Path

import networkx as nx
import numpy as np

PLANE = ("x", "y")


def write_graphml(path: Path, graph: nx.Graph) -> None:
    """Attributes one by one: a pair of numbers becomes NAME_x and NAME_y, a 2x2 matrix NAME_xx, NAME_xy and NAME_yy.

    Numbers, truths and texts stay what they are, None is left out, everything else is written as JSON text.
    """
    plain = nx.Graph(**_plain(graph.graph))
    plain.add_nodes_from((node, _plain(attributes)) for node, attributes in graph.nodes(data=True))
    plain.add_edges_from((a, b, _plain(attributes)) for a, b, attributes in graph.edges(data=True))
    nx.write_graphml_xml(plain, path)


def _plain(attributes: Mapping) -> dict[str, bool | int | float | str]:
    found: dict[str, bool | int | float | str] = {}
    for name, value in attributes.items():
        if isinstance(value, bool | int | float | str):
            found[name] = value
        elif _shape(value) == (2,) and any(isinstance(number, float) for number in value):
            found |= {f"{name}_{axis}": float(number) for axis, number in zip(PLANE, value, strict=True)}
        elif _shape(value) == (2, 2):
            (xx, xy), (_, yy) = value
            found |= {f"{name}_xx": float(xx), f"{name}_xy": float(xy), f"{name}_yy": float(yy)}
        elif value is not None:
            found[name] = json.dumps(value)
    return found


def _shape(value) -> tuple[int, ...] | None:
    """Of a list of numbers, or of lists of them; None: something else."""
    if not isinstance(value, list | tuple):
        return None
    try:
        numbers = np.array(value)
    except ValueError:  # rows of different lengths
        return None
    return numbers.shape if np.issubdtype(numbers.dtype, np.number) else None
