"""Cheapest trees against scipy's Dijkstra, and disputes against taking every edge away in turn."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.csgraph import dijkstra

from autoalign.geometry.graph import cheapest_tree, groups, hanging_in_dispute


def random_edges(n, m, seed):
    """Edges between different nodes, some of them repeated."""
    rng = np.random.default_rng(seed)
    a = rng.integers(0, n, m)
    return a, (a + rng.integers(1, n, m)) % n


def held_without(n, root, a, b, edge):
    """(n,) the nodes that hang together with the root without one edge."""
    rest = np.arange(len(a)) != edge
    group = groups(n, a[rest], b[rest])
    return group == group[root]


@pytest.mark.parametrize("seed", range(8))
def test_a_tree_is_as_cheap_as_dijkstra_says(seed):
    n, root = 30, 4
    a, b = random_edges(n, 40, seed)
    cost = np.random.default_rng(seed + 100).uniform(0.5, 2.0, len(a))
    tree = cheapest_tree(n, root, a, b, cost)
    spent = np.full(n, np.inf)
    spent[root] = 0.0
    for node in tree.order[1:]:
        edge = tree.edge[node]
        assert {a[edge], b[edge]} == {node, tree.parent[node]}
        spent[node] = spent[tree.parent[node]] + cost[edge]
    dense = np.full((n, n), np.inf)
    np.minimum.at(dense, (a, b), cost)
    np.minimum.at(dense, (b, a), cost)
    np.testing.assert_allclose(spent, dijkstra(scipy.sparse.csr_array(np.where(np.isinf(dense), 0, dense)))[root])
    np.testing.assert_array_equal(tree.reached, np.isfinite(spent))


def test_a_lone_root_is_a_tree() -> None:
    nothing = np.zeros(0, np.int64)
    tree = cheapest_tree(3, 1, nothing, nothing, np.zeros(0))
    assert tree.order.tolist() == [1]
    assert tree.reached.tolist() == [False, True, False]
    assert groups(3, nothing, nothing).tolist() == [0, 1, 2]


def test_a_node_is_in_dispute_where_a_contradicted_edge_alone_holds_it() -> None:
    n, root, shares = 20, 3, []
    for seed in range(12):
        a, b = random_edges(n, 24, seed)
        against_a, against_b = random_edges(n, 4, seed + 50)
        tree = cheapest_tree(n, root, a, b, np.ones(len(a)))
        expected = np.zeros(n, bool)
        for edge in range(len(a)):
            lost = tree.reached & ~held_without(n, root, a, b, edge)
            across = tree.reached[against_a] & tree.reached[against_b] & (lost[against_a] != lost[against_b])
            expected |= lost & across.any()
        np.testing.assert_array_equal(hanging_in_dispute(tree, a, b, against_a, against_b), expected)
        shares.append(expected.mean())
    assert min(shares) == 0 < max(shares) < 1


def test_a_ring_outvotes_an_edge_and_a_chain_does_not() -> None:
    nodes = np.arange(6)
    chain_a, chain_b, one, four = nodes[:-1], nodes[1:], np.array([1]), np.array([4])
    for closed in (False, True):
        a, b = (np.append(chain_a, 5), np.append(chain_b, 0)) if closed else (chain_a, chain_b)
        tree = cheapest_tree(6, 0, a, b, np.ones(len(a)))
        disputed = hanging_in_dispute(tree, a, b, one, four)
        assert disputed.tolist() == ([False] * 6 if closed else [False, False, True, True, True, True])
