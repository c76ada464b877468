"""A program that reads ITK's transform files, in a process of its own: damaged HDF5 may end it.

Its standard input is a list of paths as JSON; its output a list of linear transforms, each the 12
numbers of its upper three rows, or a text that says why it is none.
"""

from __future__ import annotations

import json
import resource
import sys

_MEMORY = 1 << 31  # bytes
_SECONDS = 120


def _rows(path: str) -> list[float] | str:
    import SimpleITK as sitk

    try:
        transform = sitk.ReadTransform(path)
    except RuntimeError:
        return "is damaged, or no transform of ITK"
    if transform.GetDimension() != 3 or not transform.IsLinear():
        return f"holds {transform.GetName()}, which is not linear in 3D"
    origin = transform.TransformPoint((0.0, 0.0, 0.0))
    ends = [transform.TransformPoint(tuple(float(i == k) for i in range(3))) for k in range(3)]
    return [
        value
        for row in range(3)
        for value in (*(end[row] - origin[row] for end in ends), origin[row])
    ]


def main() -> int:
    """Read the files that standard input names."""
    resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    print(json.dumps([_rows(path) for path in json.load(sys.stdin)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
