"""The ways to run the arm that are measured: one thing is changed at a time.

>>> from us_sim.evaluation.latency.cases import cases
>>> [str(case) for case in cases(quick=True)][:2]
['fem, 2,000 nodes, 512 x 512, recorder', 'fem, 8,192 nodes, 512 x 512, recorder']
"""

from __future__ import annotations

from dataclasses import dataclass, replace

RATE = 60.0
"""Poses a second."""

COARSE, FINE = (20, 10, 10), (32, 16, 16)
"""Nodes of the meshes in x, y and z."""

PLACED = ("processes", "one process", "lockstep")
"""A process a node; all nodes in one, each with a thread; or there one pose after another."""


@dataclass(frozen=True)
class Case:
    """One way to run the scene ``upper_arm``."""

    solver: str = "fem"
    mesh: tuple[int, int, int] = COARSE
    image: tuple[int, int] = (512, 512)  # columns and rows
    placed: str = "processes"  # one of `PLACED`
    recorder: bool = True
    viewer: bool = False  # somebody looks at the annotated image and the structures
    busy: bool = False  # something else keeps every core busy
    realtime: bool = True  # the nodes go before ordinary programs, where the system allows that
    seconds: float = 20.0

    @property
    def nodes(self) -> int:
        """How many the mesh has."""
        x, y, z = self.mesh
        return x * y * z

    def __str__(self) -> str:
        columns, rows = self.image
        parts = [self.solver, f"{self.nodes:,} nodes", f"{columns} x {rows}"]
        parts += [self.placed] if self.placed != PLACED[0] else []
        parts += ["recorder"] if self.recorder else []
        parts += ["viewer"] if self.viewer else []
        parts += ["cores busy"] if self.busy else []
        return ", ".join([*parts, "as ordinary programs"] if not self.realtime else parts)


LIVE = Case(mesh=FINE, seconds=300.0)
"""What the limits for a live simulation are for."""

DEMO = Case("fem_nonlinear")
"""What the demo runs."""


def cases(quick: bool) -> list[Case]:
    """Those of a run; of a quick one a few, for some seconds each."""
    base = Case()
    if quick:
        chosen = [base, LIVE, DEMO, *_beside(DEMO), replace(base, placed=PLACED[1])]
        return [replace(case, seconds=8.0) for case in chosen]
    return [
        base,
        replace(base, recorder=False),
        replace(base, viewer=True),
        replace(base, image=(256, 256)),
        replace(base, image=(768, 768)),
        *(replace(base, placed=placed) for placed in PLACED[1:]),
        replace(base, busy=True),
        *(replace(base, solver=solver) for solver in ("fem_cg", "msds", "msds_implicit")),
        DEMO,
        replace(DEMO, viewer=True),
        *_beside(DEMO),
        *(replace(DEMO, placed=placed) for placed in PLACED[1:]),
        LIVE,
        replace(LIVE, busy=True, seconds=base.seconds),
        replace(DEMO, mesh=FINE),
    ]


def _beside(case: Case) -> list[Case]:
    """The case beside something else that keeps every core busy, before it or not."""
    busy = replace(case, busy=True)
    return [busy, replace(busy, realtime=False)]
