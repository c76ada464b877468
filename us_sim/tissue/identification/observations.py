"""What was measured of a press, as one list of numbers, and what else than moduli is in it.

A force sensor has an offset (tare) on each channel, and its stamps may be late by a little more
than is known. Both are unknowns beside the moduli, in which the measurements are linear; poses
without contact, at which no model is needed, tell the offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.identification.pose_choice import ChosenPoses
from us_sim.tissue.identification.press_model import Felt
from us_sim.tissue.identification.press_record import CHANNELS, PressRecord

GROUPS = ("force", "torque", "landmark")
"""Kinds of measurements, each with a noise of its own: N, N m, m."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Places of landmarks that were seen."""

    places: NDArray[np.float64]  # (S, 3) m, frame patient
    poses: NDArray[np.intp]  # (S,) number among the chosen poses that press
    times: NDArray[np.float64]  # (S,) s


@dataclass(frozen=True, eq=False)
class Observations:
    """n numbers that were measured; those with a model come first."""

    values: NDArray[np.float64]  # (n,) N, N m or m
    groups: NDArray[np.intp]  # (n,) into GROUPS
    times: NDArray[np.float64]  # (n,) s
    depths: NDArray[np.float64]  # (n,) m, of the probe in the undeformed tissue; 0 without contact
    nuisance: NDArray[np.float64]  # (n, Q), how they change with each unknown that is no modulus
    nuisance_names: tuple[str, ...]  # Q
    channels: NDArray[np.intp]  # of the wrench, those used

    def modelled(self, felt: Felt) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n,) what a model says of these, and (n, P) its slopes by the logarithms of moduli."""
        count = felt.slopes.shape[2]
        values = [felt.wrenches[:, self.channels].ravel(), felt.places.ravel()]
        slopes = [
            felt.slopes[:, self.channels].reshape(-1, count),
            felt.place_slopes.reshape(-1, count),
        ]
        without = len(self.values) - sum(map(len, values))
        values.append(np.zeros(without))
        slopes.append(np.zeros((without, count)))
        return np.concatenate(values), np.concatenate(slopes)


def observations_of(
    record: PressRecord, chosen: ChosenPoses, seen: Seen | None = None, *, late: bool = False
) -> Observations:
    """The measurements at chosen poses.

    Args:
        record: the press.
        chosen: its poses.
        seen: landmarks.
        late: whether the wrenches' stamps may be late by a little more.
    """
    channels = np.flatnonzero(record.channels)
    count, free, width = len(chosen.pressed), len(chosen.free), len(channels)
    places = np.zeros((0, 3)) if seen is None else seen.places
    at_landmarks = np.zeros(0, np.intp) if seen is None else seen.poses
    poses = np.concatenate([chosen.pressed, chosen.free])
    felt = record.wrenches[poses][:, channels]
    names = [f"offset of {CHANNELS[channel]}" for channel in channels] + ["delay"] * late
    offsets = np.tile(np.eye(width), (count + free, 1))
    if late:
        offsets = np.column_stack([offsets, record.rates[poses][:, channels].ravel()])
    split, seen_count = count * width, places.size
    kinds = np.tile(np.where(channels < 3, 0, 1), count + free)
    depths = np.maximum(-chosen.clearance, 0.0)

    def joined(of_wrenches: NDArray, of_landmarks: NDArray) -> NDArray:
        return np.concatenate([of_wrenches[:split], of_landmarks, of_wrenches[split:]])

    return Observations(
        values=joined(felt.ravel(), places.ravel()),
        groups=joined(kinds, np.full(seen_count, 2)),
        times=joined(
            np.repeat(record.times[poses], width),
            np.repeat(np.zeros(0) if seen is None else seen.times, 3),
        ),
        depths=joined(
            np.repeat(depths[poses], width), np.repeat(depths[chosen.pressed][at_landmarks], 3)
        ),
        nuisance=joined(offsets, np.zeros((seen_count, offsets.shape[1]))),
        nuisance_names=tuple(names),
        channels=channels,
    )
