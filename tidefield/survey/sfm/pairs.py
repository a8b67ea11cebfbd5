"""Choose pairs of photographs that may overlap.

Candidates come from positions and times. Of these the promising pairs are selected by matching only the largest
features (preemptive matching: Wu, Towards Linear-Time Incremental Structure from Motion, 2013).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from heapq import heapify, heappush, heapreplace
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
"""Nearest places with whose photographs each is paired, where positions exist. Mostly a photograph is a place."""
APART = 1 / 12
"""Photographs nearer than this share of the distance to neighbour NEIGHBOURS / 2 share a place: of cameras that fly
together, or of repeated flights. Counted one by one they would leave no place to those of the next flight line."""
MOST_AT_PLACE = 10
"""Of more photographs, as of a drone that hovers, these are a place of their own."""
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
MAX_PER_PLACE = 2
"""Pairs of a photograph with those of one place."""
AT_ONCE = 64
"""Pairs whose largest features are matched at once."""


def places_of(photographs: Sequence[Photograph]) -> list[int]:
    """Number the places of photographs; one without a position has a place of its own."""
    places = np.arange(len(photographs))
    xy_m = positions_m(photographs)
    located = np.flatnonzero(np.isfinite(xy_m[:, 0]))
    if len(located) <= NEIGHBOURS:
        return places.tolist()
    xy_m = xy_m[located]
    found = np.arange(len(located))
    for _ in range(2):  # the second time between places instead of photographs
        some = xy_m[np.unique(found, return_index=True)[1]]
        apart_m = np.median(KDTree(some).query(some, k=min(NEIGHBOURS // 2, len(some) - 1) + 1)[0][:, -1])
        if apart_m == 0:
            break
        found = np.unique(np.round(xy_m / (APART * apart_m)), axis=0, return_inverse=True)[1].reshape(-1)
    at_place: Counter[int] = Counter()
    first: dict[tuple[int, int], int] = {}
    for k, place in zip(located.tolist(), found.tolist(), strict=True):
        places[k] = first.setdefault((place, at_place[place] // MOST_AT_PLACE), k)
        at_place[place] += 1
    return places.tolist()


def candidate_pairs(photographs: Sequence[Photograph], places: Sequence[int]) -> list[Pair]:
    """Choose pairs that may overlap, by positions and times; a photograph without a position is paired with all.

    Args:
        places: from `places_of`.
    """
    count = len(photographs)
    if count <= EXHAUSTIVE:
        return list(combinations(range(count), 2))
    located = [k for k, p in enumerate(photographs) if p.position is not None]
    pairs: set[Pair] = set()
    if len(located) > NEIGHBOURS:
        at_place: defaultdict[int, list[int]] = defaultdict(list)
        for k in located:
            at_place[places[k]].append(k)
        there = list(at_place.values())
        xy_m = positions_m(photographs)[list(at_place)]
        most = min(NEIGHBOURS, len(there) - 1)
        distances, nearest = (np.reshape(of, (len(there), -1)) for of in KDTree(xy_m).query(xy_m, k=most + 1))
        # A field with fewer photographs than that has its next neighbours in another field, far away.
        limit = MAX_RELATIVE_DISTANCE * np.median(distances[:, min(NEIGHBOURS // 2, most)])
        for i, j in zip(*np.nonzero(distances <= limit), strict=True):
            pairs.update(_pair(a, b) for a in there[i] for b in there[nearest[i, j]] if a != b)
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


def select_pairs(
    candidates: Sequence[Pair], previews: Float[Tensor, "V K D"], places: Sequence[int], progress: Progress
) -> list[Pair]:
    """Select the candidates whose largest features match, and the best pairs of every photograph.

    Args:
        previews: from `preview_descriptors`.
        places: from `places_of`.
    """
    partners: defaultdict[int, list[int]] = defaultdict(list)
    for i, j in candidates:
        partners[i].append(j)
    # Of each photograph the best so far, the worst of them first, as (matches, -i, -j, place of the other): candidates
    # may be millions.
    best: defaultdict[int, list[tuple[int, int, int, int]]] = defaultdict(list)
    for done, (i, others) in enumerate(sorted(partners.items()), start=1):
        for start in range(0, len(others), AT_ONCE):
            part = others[start : start + AT_ONCE]
            counts = (match_descriptors(previews[i].expand(len(part), -1, -1), previews[part]) >= 0).sum(-1)
            for j, matches in zip(part, counts.tolist(), strict=True):
                for k, other in ((i, j), (j, i)):
                    _keep(best[k], (matches, -i, -j, places[other]))
        progress(done, len(partners))
    selected: set[Pair] = set()
    for heap in best.values():
        for rank, (matches, i, j, _) in enumerate(sorted(heap, reverse=True)):
            if rank < MIN_PAIRS or matches >= MIN_PREVIEW_MATCHES:
                selected.add((-i, -j))
    return sorted(selected)


def _keep(best: list[tuple[int, int, int, int]], found: tuple[int, int, int, int]) -> None:
    """Keep a pair if it is among the MAX_PAIRS best, and the MAX_PER_PLACE best with that place."""
    if len(best) == MAX_PAIRS and found < best[0]:
        return
    alike = [one for one in best if one[3] == found[3]]
    if len(alike) == MAX_PER_PLACE:
        worst = min(alike)
        if worst < found:
            best[best.index(worst)] = found
            heapify(best)
    elif len(best) < MAX_PAIRS:
        heappush(best, found)
    else:
        heapreplace(best, found)
