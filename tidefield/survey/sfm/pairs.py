"""Which photographs may show the same ground: pairs worth matching."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from tidefield.survey.io.positions import metres_around
from tidefield.survey.survey import Photograph

Pair = tuple[int, int]

RATIO, FARTHEST_RAD = 0.8, 0.7
"""A match is nearer than `RATIO` times the second nearest and than `FARTHEST_RAD`, as angles: COLMAP's values."""
NEARBY = 24
"""Photographs around each that may overlap it, where positions are known."""
FAR = 4.0
"""Times the usual distance to the middle one of them; photographs farther apart show nothing in common."""
IN_SEQUENCE = 2
"""Photographs taken just before and after are paired in any case, ..."""
PAUSE_S = 600.0
"""... unless so much time lies between: a drone that has landed begins elsewhere."""
FEW = 40
"""So few photographs are all paired with each other; it takes a minute and misses nothing."""
GLANCE = 300
"""Features (the largest) by which a pair is judged before it is matched in full (preemptive matching: Wu, Towards
Linear-Time Incremental Structure from Motion, 2013)."""
PROMISING = 4
"""Matches among these that make a pair promising."""
BEST = 6
"""Pairs of each photograph that are matched however few these matches are."""
MOST = 30
"""Pairs of each photograph that are matched at most."""


def candidates(photographs: Sequence[Photograph]) -> list[Pair]:
    """Pairs of indices (i < j) of photographs that may overlap, by their positions and times.

    A photograph without a position is paired with all others.
    """
    count = len(photographs)
    if count <= FEW:
        return list(combinations(range(count), 2))
    located = {k: p.position for k, p in enumerate(photographs) if p.position is not None}
    placed = list(located)
    pairs: set[Pair] = set()
    if len(placed) > NEARBY:
        xy = metres_around(list(located.values()))
        apart, near = KDTree(xy).query(xy, k=NEARBY + 1)
        # Where a field has fewer photographs than that, the next are those of another field, far away.
        far = FAR * np.median(np.asarray(apart)[:, NEARBY // 2])
        rows = zip(np.asarray(near), np.asarray(apart), strict=True)
        pairs |= {_pair(placed[i], placed[j]) for i, (row, d) in enumerate(rows) for j in row[d <= far] if i != j}
    else:
        placed = []
    lost = sorted(set(range(count)) - set(placed))
    pairs |= {_pair(k, other) for k in lost for other in range(count) if other != k}
    order = sorted(range(count), key=lambda k: (photographs[k].time_s, photographs[k].name))
    for ahead in range(1, IN_SEQUENCE + 1):
        pairs |= {
            _pair(a, b)
            for a, b in zip(order, order[ahead:], strict=False)
            if not photographs[b].time_s - photographs[a].time_s > PAUSE_S  # they may have no time
        }
    return sorted(pairs)


def matched(ours: Float[Tensor, "... K D"], theirs: Float[Tensor, "... L D"]) -> Int[Tensor, "... K"]:
    """For each of our descriptors the index of its match among theirs, or -1.

    A match is a pair of mutual nearest neighbours that stands out from the second nearest.

    Args:
        ours, theirs: descriptors of unit length (zeros match nothing).
    """
    cosine = ours @ theirs.transpose(-1, -2)
    best, index = cosine.topk(min(2, theirs.shape[-2]), dim=-1)
    angle = best.float().clamp(-1, 1).acos()
    back = cosine.argmax(dim=-2)
    mutual = back.gather(-1, index[..., 0]) == torch.arange(ours.shape[-2], device=ours.device)
    good = mutual & (angle[..., 0] < RATIO * angle[..., -1]) & (angle[..., 0] < FARTHEST_RAD)
    return torch.where(good, index[..., 0], -1)


def promising(
    pairs: Sequence[Pair], glances: Float[Tensor, "V K D"], progress: Callable[[int, int], object]
) -> list[Pair]:
    """Those of the pairs whose largest features match, and every photograph's best.

    Args:
        glances: descriptors of unit length of each photograph's largest features; zeros where it has fewer.
    """
    partners: dict[int, list[int]] = {}
    for i, j in pairs:
        partners.setdefault(i, []).append(j)
    score: dict[Pair, int] = {}
    for done, (i, others) in enumerate(sorted(partners.items()), start=1):
        for start in range(0, len(others), 64):
            part = others[start : start + 64]
            found = (matched(glances[i].expand(len(part), -1, -1), glances[part]) >= 0).sum(-1)
            score |= {(i, j): int(n) for j, n in zip(part, found, strict=True)}
        progress(done, len(partners))
    ranked: dict[int, list[Pair]] = {}
    for pair in sorted(score, key=lambda p: (-score[p], p)):
        for k in pair:
            ranked.setdefault(k, []).append(pair)
    kept: set[Pair] = set()
    for own in ranked.values():
        kept |= set(own[:BEST]) | {pair for pair in own[:MOST] if score[pair] >= PROMISING}
    return sorted(kept)


def _pair(i: int, j: int) -> Pair:
    return (int(i), int(j)) if i < j else (int(j), int(i))


def glances(descriptors: Sequence[np.ndarray]) -> Float[Tensor, "V K D"]:
    """The largest features' descriptors (given largest first) of every photograph, of unit length.

    What a photograph lacks are zeros, which match nothing.
    """
    table = torch.zeros(len(descriptors), GLANCE, 128)
    for row, own in zip(table, descriptors, strict=True):
        part = torch.from_numpy(own[:GLANCE].astype(np.float32))
        row[: len(part)] = torch.nn.functional.normalize(part, dim=1)
    return table
