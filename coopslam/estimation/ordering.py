"""The order in which variables are eliminated: nested dissection, whose trees stay shallow on long chains.

COLAMD's grow as deep as a chain is long and overflow the stack. METIS, as GTSAM calls it, expects that every variable
has a neighbour: beside others one without leads to a short ordering, an exception, or a killed process.
"""

import gtsam


def nested_dissection(graph: gtsam.NonlinearFactorGraph | gtsam.GaussianFactorGraph) -> gtsam.Ordering:
    """All variables of the graph; first those that no factor ties to another, which fill in nothing."""
    single, tied, ties = set(), set(), []
    for factor in map(graph.at, range(graph.size())):
        if factor is None:  # a removed one
            continue
        keys = factor.keys()
        if len(keys) > 1:
            tied.update(keys)
            ties.append(factor)
        else:
            single.update(keys)
    alone = sorted(single - tied)
    if not alone:
        return _metis(graph) if ties else gtsam.Ordering()
    ordering = gtsam.Ordering()
    for key in alone:
        ordering.push_back(key)
    if ties:
        among = type(graph)()
        for factor in ties:
            among.push_back(factor)
        dissected = _metis(among)
        for place in range(dissected.size()):
            ordering.push_back(dissected.at(place))
    return ordering


def _metis(graph: gtsam.NonlinearFactorGraph | gtsam.GaussianFactorGraph) -> gtsam.Ordering:
    if isinstance(graph, gtsam.NonlinearFactorGraph):
        return gtsam.Ordering.MetisNonlinearFactorGraph(graph)
    return gtsam.Ordering.MetisGaussianFactorGraph(graph)
