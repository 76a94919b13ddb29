"""What a graph does not tie down, in words: solvers return quietly without it."""

import re
from collections.abc import Sequence
from itertools import chain

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coopslam.errors import UnderDetermined
from coopslam.estimation.keys import describe, is_landmark

_NAMED = 5  # variables named in one message


def check(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, robots: Sequence[str] = ()) -> None:
    """Raises UnderDetermined with everything that `complaints` finds."""
    found = complaints(graph, values, robots)
    if found:
        raise UnderDetermined("; ".join(found))


def complaints(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, robots: Sequence[str] = ()) -> list[str]:
    """One sentence for each reason why the graph cannot be solved for the values.

    Factors without a value for a variable; variables without factor, with fewer equations than unknowns, or
    not connected to any prior. It counts and connects: a geometric degeneracy shows up when the graph is eliminated.
    """
    members, rows = [], []
    for factor in map(graph.at, range(graph.size())):
        if factor is not None:  # a removed one
            members.append(factor.keys())
            rows.append(factor.dim())
    keys = np.sort(np.array(values.keys(), dtype=np.uint64))
    sizes = np.array([len(of_factor) for of_factor in members], dtype=int)
    member = np.fromiter(chain.from_iterable(members), dtype=np.uint64, count=sizes.sum())
    factor_of = np.repeat(np.arange(len(members)), sizes)
    known = np.isin(member, keys)
    variable, factor_of, absent = np.searchsorted(keys, member[known]), factor_of[known], np.unique(member[~known])

    equations = np.bincount(variable, np.array(rows, dtype=int)[factor_of], len(keys))
    nodes = len(keys) + len(members)  # variables and factors; each factor ties its variables
    ties = coo_array((np.ones(len(variable)), (variable, len(keys) + factor_of)), shape=(nodes, nodes))
    _, group = connected_components(ties, False)
    held = np.isin(group[: len(keys)], group[variable[sizes[factor_of] == 1]])
    unknowns = np.array([2 if is_landmark(key) else 3 for key in keys.tolist()])
    bare = equations == 0
    found = [
        ("have factors but no value", absent),
        ("appear in no factor", keys[bare]),
        ("are not connected to a prior", keys[~held & ~bare]),
        ("have fewer equations than unknowns", keys[held & ~bare & (equations < unknowns)]),
    ]
    return [f"{_listing(variables.tolist(), robots)} {what}" for what, variables in found if len(variables)]


def in_words(
    error: RuntimeError, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, robots: Sequence[str] = ()
) -> Exception:
    """GTSAM's complaint about an open direction, with the name of the variable; other errors as they are.

    Where counting finds nothing untied, it is the numbers that are singular.
    """
    found = re.search(r"variable\s+(\d+)", str(error))
    if "ndetermin" not in str(error) or not found:
        return error
    where = describe(int(found[1]), robots)
    if complaints(graph, values, robots):
        return UnderDetermined(f"the records do not tie down what is around {where}")
    return UnderDetermined(f"the system of equations is numerically singular around {where}")


def _listing(keys: list[int], robots: Sequence[str]) -> str:
    names = ", ".join(describe(key, robots) for key in keys[:_NAMED])
    return names if len(keys) <= _NAMED else f"{names} and {len(keys) - _NAMED} more"
