"""What a graph does not tie down, in words: solvers return quietly without it."""

import re
from collections import Counter
from collections.abc import Sequence

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
    keys = list(values.keys())
    number = {key: i for i, key in enumerate(keys)}
    rows, first, second, anchored, absent = np.zeros(len(keys), int), [], [], set(), Counter()
    for i in range(graph.size()):
        factor = graph.at(i)
        if factor is None:
            continue  # a removed one
        factor_keys, dim = factor.keys(), factor.dim()
        absent.update(key for key in factor_keys if key not in number)
        members = [number[key] for key in factor_keys if key in number]
        rows[members] += dim
        first += members[:-1]
        second += members[1:]
        if len(members) == len(factor_keys) == 1:
            anchored.add(members[0])
    _, group = connected_components(coo_array((np.ones(len(first)), (first, second)), shape=(len(keys),) * 2), False)
    held = np.isin(group, [group[i] for i in anchored])
    unknowns = np.array([2 if is_landmark(key) else 3 for key in keys])
    bare, unheld, thin = rows == 0, ~held & (rows > 0), held & (rows > 0) & (rows < unknowns)
    found = [
        ("have factors but no value", list(absent)),
        ("appear in no factor", [keys[i] for i in np.flatnonzero(bare)]),
        ("are not connected to a prior", [keys[i] for i in np.flatnonzero(unheld)]),
        ("have fewer equations than unknowns", [keys[i] for i in np.flatnonzero(thin)]),
    ]
    return [f"{_listing(variables, robots)} {what}" for what, variables in found if variables]


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
