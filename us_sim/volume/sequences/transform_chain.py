"""Chains of transforms from one frame to another, each forwards or inverted.

>>> from us_sim.volume.sequences.transform_chain import shortest_chain
>>> chain = shortest_chain(["ProbeToTracker", "ReferenceToTracker"], "Probe", "Reference")
>>> chain.reference, chain.steps
('Reference', (('ProbeToTracker', True), ('ReferenceToTracker', False)))
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from us_sim.volume.sequences.transform_name import split_transform_name


@dataclass(frozen=True)
class TransformChain:
    """Transforms that lead to a reference frame one after the other, each forwards or inverted."""

    reference: str
    steps: tuple[tuple[str, bool], ...]


def shortest_chain(names: Iterable[str], start: str, goal: str) -> TransformChain | None:
    """The chain of the fewest transforms from one frame to another; None where there is none."""
    return _chains(names, start).get(goal)


def frames_reached(names: Iterable[str], start: str) -> tuple[str, ...]:
    """The frames to which chains lead from a frame, the nearest first."""
    return tuple(_chains(names, start))


def _chains(names: Iterable[str], start: str) -> dict[str, TransformChain]:
    """The shortest chain to each frame that is reached, the nearest first."""
    steps: dict[str, list[tuple[str, str, bool]]] = {}  # from a frame: where to, by what, forwards
    for name in names:
        if ends := split_transform_name(name):
            steps.setdefault(ends[0], []).append((ends[1], name, True))
            steps.setdefault(ends[1], []).append((ends[0], name, False))
    chains = {start: TransformChain(start, ())}
    waiting = deque([start])
    while waiting:
        frame = waiting.popleft()
        for end, name, forward in steps.get(frame, []):
            if end not in chains:
                chains[end] = TransformChain(end, (*chains[frame].steps, (name, forward)))
                waiting.append(end)
    del chains[start]
    return chains
