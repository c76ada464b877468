"""What each voxel of a volume is: numbers, with the names and colours of the structures.

>>> import numpy as np
>>> from us_sim.volume.label_map import LabelMap
>>> labels = np.zeros((4, 4, 4), np.uint8)
>>> labels[1:3, 1:3, 1:3] = 6
>>> found = LabelMap(labels, {6: "vein"})
>>> found.colours[6], found.voxels
((0.25, 0.4, 0.85), {'vein': 8})
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.anatomical_colours import Colour, anatomical_colour
from us_sim.volume.volume import Volume


@dataclass(frozen=True, eq=False)
class LabelMap:
    """Labels on the grid of some volume; 0 is in no structure.

    Raises:
        VolumeError: a label of the voxels has no name, or two have the same.
    """

    labels: NDArray[np.uint8]  # (i, j, k)
    names: Mapping[int, str]
    colours: Mapping[int, Colour] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    """What a person should know of how they came about, a sentence each."""

    def __post_init__(self) -> None:
        names = dict(self.names)
        for label in np.flatnonzero(self._counts):
            if label and int(label) not in names:
                raise VolumeError(f"label {label} has no name: name it")
        if len(set(names.values())) < len(names):
            raise VolumeError(f"two structures have the same name, of {', '.join(names.values())}")
        colours = {n: self.colours.get(n) or anatomical_colour(name) for n, name in names.items()}
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "colours", colours)

    @cached_property
    def voxels(self) -> dict[str, int]:
        """The number of voxels of each structure, by name."""
        return {name: int(self._counts[label]) for label, name in self.names.items()}

    @cached_property
    def _counts(self) -> NDArray[np.int64]:
        # A slice at a time, since bincount would make 64-bit numbers of all voxels at once.
        return np.sum([np.bincount(one.ravel(), minlength=256) for one in self.labels], axis=0)

    def on(self, volume: Volume) -> Volume:
        """A volume of the same grid with these labels."""
        return dataclasses.replace(volume, labels=self.labels, label_names=self.names)
