"""Choose pairs of photographs that may overlap.

Candidates come from positions and times. Of these the promising pairs are selected by matching only the largest
features (preemptive matching: Wu, Towards Linear-Time Incremental Structure from Motion, 2013).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from heapq import heappush, heappushpop
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from tidefield.data.sift import MAX_ANGLE_RAD, MAX_RATIO
from tidefield.survey.io.positions import positions_m
from tidefield.survey.quality.assessment import capture_order
from tidefield.survey.survey import Photograph, Progress

Pair = tuple[int, int]
"""Indices of two photographs, the smaller first."""

NEIGHBOURS = 24
"""Nearest photographs with which each is paired, where positions exist."""
MAX_RELATIVE_DISTANCE = 4.0
"""Maximum distance of a pair in medians of the distance to neighbour NEIGHBOURS / 2; beyond it nothing overlaps."""
SEQUENTIAL = 2
"""Photographs taken just before and after are paired wherever they are, ..."""
MAX_PAUSE_S = 600.0
"""... unless more time lies between: then the drone has landed and may have been moved."""
EXHAUSTIVE = 40
"""Up to this number of photographs, all pairs are candidates: it takes a minute and misses nothing."""
PREVIEW = 300
"""Number of the largest features by which a candidate is judged before it is matched in full."""
MIN_PREVIEW_MATCHES = 4
"""Matches among these that make a pair promising."""
MIN_PAIRS, MAX_PAIRS = 6, 30
"""Pairs per photograph: the best are selected however few their matches are, and no more than the maximum."""
AT_ONCE = 64
"""Pairs whose largest features are matched at once."""


def candidate_pairs(photographs: Sequence[Photograph]) -> list[Pair]:
    """Choose pairs that may overlap, by positions and times; a photograph without a position is paired with all."""
    count = len(photographs)
    if count <= EXHAUSTIVE:
        return list(combinations(range(count), 2))
    located = [k for k, p in enumerate(photographs) if p.position is not None]
    pairs: set[Pair] = set()
    if len(located) > NEIGHBOURS:
        xy_m = positions_m(photographs)[located]
        distances, nearest = map(np.asarray, KDTree(xy_m).query(xy_m, k=NEIGHBOURS + 1))
        # A field with fewer photographs than that has its next neighbours in another field, far away.
        limit = MAX_RELATIVE_DISTANCE * np.median(distances[:, NEIGHBOURS // 2])
        for i, j in zip(*np.nonzero(distances <= limit), strict=True):
            if nearest[i, j] != i:
                pairs.add(_pair(located[i], located[nearest[i, j]]))
    else:
        located = []
    order = capture_order(photographs)
    for offset in range(1, SEQUENTIAL + 1):
        for a, b in zip(order, order[offset:], strict=False):
            # "not >", because a time may be unknown (NaN).
            if not photographs[b].time_s - photographs[a].time_s > MAX_PAUSE_S:
                pairs.add(_pair(a, b))
    everyone = list(range(count))
    without = set(everyone) - set(located)
    # There may be millions of these, for which a set would take twice the memory.
    others = [_pair(k, other) for k in without for other in everyone if other > k or other not in without]
    return sorted([*others, *(pair for pair in pairs if without.isdisjoint(pair))])


def _pair(i: int, j: int) -> Pair:
    return (i, j) if i < j else (j, i)


def preview_descriptors(descriptors: Sequence[UInt8[np.ndarray, "_ 128"]]) -> Float[Tensor, "V K D"]:
    """Stack the first PREVIEW descriptors of each photograph at unit length, padded with zeros, which match nothing."""
    table = torch.zeros(len(descriptors), PREVIEW, 128)
    for row, largest_first in zip(table, descriptors, strict=True):
        part = torch.from_numpy(largest_first[:PREVIEW].astype(np.float32))
        row[: len(part)] = torch.nn.functional.normalize(part, dim=1)
    return table


def match_descriptors(first: Float[Tensor, "... K D"], second: Float[Tensor, "... L D"]) -> Int[Tensor, "... K"]:
    """Match descriptors of unit length: mutual nearest neighbours that pass the ratio test.

    Returns:
        For each of the first descriptors the index of its match in the second, or -1.
    """
    cosine = first @ second.transpose(-1, -2)
    best, index = cosine.topk(min(2, second.shape[-2]), dim=-1)
    angle = best.float().clamp(-1, 1).acos()
    back = cosine.argmax(dim=-2)
    mutual = back.gather(-1, index[..., 0]) == torch.arange(first.shape[-2], device=first.device)
    good = mutual & (angle[..., 0] < MAX_RATIO * angle[..., -1]) & (angle[..., 0] < MAX_ANGLE_RAD)
    return torch.where(good, index[..., 0], -1)


def select_pairs(candidates: Sequence[Pair], previews: Float[Tensor, "V K D"], progress: Progress) -> list[Pair]:
    """Select the candidates whose largest features match, and the best pairs of every photograph.

    Args:
        previews: from `preview_descriptors`.
    """
    partners: defaultdict[int, list[int]] = defaultdict(list)
    for i, j in candidates:
        partners[i].append(j)
    # Of each photograph, the best so far, the worst of them first, as (matches, -i, -j): candidates may be millions.
    best: defaultdict[int, list[tuple[int, int, int]]] = defaultdict(list)
    for done, (i, others) in enumerate(sorted(partners.items()), start=1):
        for start in range(0, len(others), AT_ONCE):
            part = others[start : start + AT_ONCE]
            counts = (match_descriptors(previews[i].expand(len(part), -1, -1), previews[part]) >= 0).sum(-1)
            for j, matches in zip(part, counts.tolist(), strict=True):
                for k in (i, j):
                    keep = heappush if len(best[k]) < MAX_PAIRS else heappushpop
                    keep(best[k], (matches, -i, -j))
        progress(done, len(partners))
    selected: set[Pair] = set()
    for heap in best.values():
        for rank, (matches, i, j) in enumerate(sorted(heap, reverse=True)):
            if rank < MIN_PAIRS or matches >= MIN_PREVIEW_MATCHES:
                selected.add((-i, -j))
    return sorted(selected)
