"""Which nodes hang together, by which edges, and which of them hang by one edge alone; knows no transforms.

Edges are given by their ends `a` and `b`, (m,) each, numbers of nodes from 0; they have no direction and may repeat.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from autoalign.geometry.homography import Array, Mask

Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Tree:
    """The cheapest way from every node to the root."""

    order: Indices  # (k,) the nodes that hang together with the root, which comes first; each after its parent
    parent: Indices  # (n,) -1 for the root, and for nodes that do not hang together with it
    edge: Indices  # (n,) the edge to the parent, -1 likewise

    @property
    def reached(self) -> Mask:
        """(n,)"""
        mask = np.zeros(len(self.parent), np.bool_)
        mask[self.order] = True
        return mask


def cheapest_tree(n: int, root: int, a: Indices, b: Indices, cost: Array) -> Tree:
    """The cheapest paths from `root` to each of `n` nodes; costs (m,) are positive and add up (Dijkstra 1959)."""
    around: list[list[tuple[int, int]]] = [[] for _ in range(n)]
    for edge, (u, v) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
        around[u].append((v, edge))
        around[v].append((u, edge))
    order, parent, by = [], np.full(n, -1), np.full(n, -1)
    seen = np.zeros(n, np.bool_)
    waiting: list[tuple[float, int, int, int]] = [(0.0, root, -1, -1)]
    while waiting:
        spent, node, before, edge = heapq.heappop(waiting)
        if seen[node]:
            continue
        seen[node] = True
        order.append(node)
        parent[node], by[node] = before, edge
        for other, through in around[node]:
            if not seen[other]:
                heapq.heappush(waiting, (spent + float(cost[through]), other, node, through))
    return Tree(order=np.array(order), parent=parent, edge=by)


def groups(n: int, a: Indices, b: Indices) -> Indices:
    """(n,) a number for each node, the same for those that hang together."""
    edges = scipy.sparse.coo_array((np.ones(len(a)), (a, b)), shape=(n, n))
    return np.asarray(scipy.sparse.csgraph.connected_components(edges, directed=False)[1], np.int64)


def hanging_in_dispute(tree: Tree, a: Indices, b: Indices, against_a: Indices, against_b: Indices) -> Mask:
    """(n,) True for nodes that one edge alone holds to the root, while an edge of those `against` contradicts it.

    `tree` is one of the edges `a`, `b`. An edge of the tree is alone if no other edge leads around it; each other edge
    leads around those between its ends. So give each a random label: the edges that lead out of the branch above a node
    are those whose labels do not cancel in the exclusive or over the branch.
    """
    others = np.setdiff1d(np.arange(len(a)), tree.edge)
    around = _leading_out(tree, a[others], b[others])
    contradicted = _leading_out(tree, against_a, against_b)
    disputed = np.zeros(len(tree.parent), np.bool_)
    for node in tree.order[1:]:
        disputed[node] = disputed[tree.parent[node]] or (contradicted[node] and not around[node])
    return disputed


def _leading_out(tree: Tree, a: Indices, b: Indices) -> Mask:
    """(n,) whether any of the edges leads out of the branch that begins with a node."""
    inside = tree.reached[a] & tree.reached[b]
    labels = np.random.default_rng(0).integers(1, 2**63, inside.sum())
    sums = np.zeros(len(tree.parent), np.int64)
    for end in (a[inside], b[inside]):
        np.bitwise_xor.at(sums, end, labels)
    for node in tree.order[:0:-1]:
        sums[tree.parent[node]] ^= sums[node]
    return np.asarray(sums != 0)
