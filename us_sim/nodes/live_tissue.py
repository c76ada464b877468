"""The tissue that a node deforms, with everything of it that may be set while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import TissueDeformerSettings
from us_sim.progress import late_progress
from us_sim.scene.building import materials_of, tissue_model_of, volume_of
from us_sim.settings.registry import SOLVERS
from us_sim.tissue.deformation import Deformation
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.switching import Failed, Plan, Preparation, Prepared, SwitchableTissue

OWN = "tissue_deformer"
LOOK_S = 0.1
"""How often it is looked whether what was set is ready, when no pose comes."""


class LiveTissue:
    """A tissue whose method, methods' settings and materials are parameters of a node.

    What is set is made ready in a thread, and the tissue goes on as it was until then; the next
    frame begins with it. What cannot be made is said, and its parameters are set back. In lockstep
    a frame waits for it.

    Args:
        node: that gets the parameters, of a scene with tissue.

    Raises:
        UsSimError: the scene's tissue cannot be made, or a parameter's value will not do.
    """

    def __init__(self, node: SceneNode) -> None:
        scene, tissue = node.scene, node.scene.tissue
        assert tissue is not None
        self._node = node
        groups = {OWN: Group(TissueDeformerSettings(solver=tissue.solver))}
        for name in SOLVERS.importable:
            given = tissue.settings.get(name) or SOLVERS.settings(name)()
            groups[name] = Group(given, prefix=f"{name}.")
        for label, material in tissue.materials.items():
            groups[f"materials.{label}"] = Group(material, prefix=f"materials.{label}.")
        # Before the volume, which may take a minute to make.
        self._live = LiveSettings(node, groups, use=self._use)
        values = self._live.values
        self._volume = volume_of(scene)
        given_materials = _materials(values)
        self._scene = replace(scene, tissue=replace(tissue, materials=given_materials))
        model = tissue_model_of(self._scene, self._volume, node.get_logger().info)
        node.get_logger().info(
            f"preparing {values[OWN].solver} for {len(model.mesh.nodes)} nodes, "
            f"{len(model.mesh.tetrahedra)} tetrahedra"
        )
        show = late_progress("preparing the tissue")
        self.tissue = SwitchableTissue(model, values[OWN].solver, _settings(values), show)
        if values[OWN].compare_with:
            self.tissue.compare_with(values[OWN].compare_with, show)
        self._current = dict(values)  # what the tissue is deformed by
        self._asked = dict(values)  # what is being made ready
        self._preparation = Preparation(self.tissue)
        node.create_timer(LOOK_S, self._tick)

    @property
    def state(self) -> str:
        """The method in use, and what is being made ready."""
        preparing = self._preparation.state
        return f"{self.tissue.name}, {preparing}" if preparing else self.tissue.name

    def deform(self, pose: Pose) -> Deformation:
        """One frame, with what is ready of what was set.

        Raises:
            UsSimError: the pose cannot be used.
        """
        self._look()
        try:
            return self.tissue.deform(pose)
        except UsSimError:
            raise
        except Exception:
            self.tissue.reset()  # it may have been left halfway
            raise

    def _use(self, values: dict[str, Any]) -> None:
        """Make ready what was set."""
        if values == self._asked:
            return
        self._asked = dict(values)
        if values == self._current:
            self._preparation.drop()
            self._tell_preparing()
            self._node.get_logger().info(
                f"set back: {self.tissue.name} goes on as it is, and what was being prepared is "
                f"dropped"
            )
            return
        plan = self._plan(values)
        if self._node.lockstep:
            self._settle(self._made(plan))
            return
        self._node.get_logger().info(
            f"{plan.reason}: being prepared; {self.tissue.name} goes on until it is ready"
        )
        self._preparation.want(plan)
        self._tell_preparing()

    def _plan(self, values: Mapping[str, Any]) -> Plan:
        """What to make for these settings."""
        own = values[OWN]
        changed = [key for key in values if values[key] != self._current[key]]
        other = any(key.startswith("materials.") for key in changed)
        materials, model = _materials(values), self.tissue.model

        def with_materials() -> TissueModel:
            made = materials_of(self._scene, materials, model.mesh, self._volume)
            return replace(model, materials=made)

        compared = f" compared with {own.compare_with}" if own.compare_with else ""
        reasons = [f"{own.solver}{compared}" if key == OWN else key for key in changed]
        return Plan(
            own.solver,
            own.compare_with or "",
            _settings(values),
            with_materials if other else None,
            ", ".join(reasons),
        )

    def _made(self, plan: Plan) -> Prepared | Failed:
        try:
            return self.tissue.make(plan, late_progress("preparing the tissue"))
        except UsSimError as error:
            return Failed(plan, str(error))

    def _tick(self) -> None:
        """Look, and tell diagnostics how far it is, also while no pose comes."""
        if self._preparation.state:
            self._node.health.state, self._node.health.preparing = (
                self.state,
                self._preparation.state,
            )
        self._look()

    def _tell_preparing(self) -> None:
        """Tell diagnostics at once that something is being prepared, or no longer is."""
        self._node.health.state, self._node.health.preparing = self.state, self._preparation.state
        self._node.health.report()

    def _look(self) -> None:
        """Go on with what is ready, or say why it never will be."""
        outcome = self._preparation.take()
        if outcome is not None:
            self._settle(outcome)

    def _settle(self, outcome: Prepared | Failed) -> None:
        self._take(outcome)
        self._node.health.state = self.tissue.name  # also while no pose comes
        self._node.health.preparing = ""
        self._node.health.report()

    def _take(self, outcome: Prepared | Failed) -> None:
        if isinstance(outcome, Failed):
            self._node.health.problem(
                "setting", f"{outcome.plan.reason}: {outcome.problem}; it is set back"
            )
            self._asked = dict(self._current)
            self._live.restore(self._current)
            return
        before, compared = self.tissue.name, self.tissue.compared
        self.tissue.adopt(outcome)
        self._current = dict(self._asked)
        log = self._node.get_logger()
        if self.tissue.name != before:
            log.info(f"switched to {self.tissue.name}")
        if self.tissue.compared != compared and self.tissue.compared:
            log.info(f"comparing with {self.tissue.compared}")
        log.info(f"{outcome.plan.reason}: in use from now on")


def _settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the solvers, by their names."""
    return {name: values[name] for name in SOLVERS.importable}


def _materials(values: Mapping[str, Any]) -> dict[str, Material]:
    """Those of the materials, by their labels."""
    return {
        key.removeprefix("materials."): value
        for key, value in values.items()
        if key.startswith("materials.")
    }
