"""Young's moduli that were found for a case, written into its ``case.yaml``.

>>> from us_sim.volume.cases.moduli import with_moduli
>>> from us_sim.volume.cases.settings import CaseSettings, CaseStructure
>>> case = CaseSettings("arm", structures={"vein": CaseStructure(1)})
>>> fitted = with_moduli(case, {"vein": 2e3, "tissue": 9e3})
>>> fitted.material_of("vein").young_modulus, fitted.material_of("tissue").young_modulus
(2000.0, 9000.0)
>>> fitted.material_of("vein").lumen_pressure == case.material_of("vein").lumen_pressure
True
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping

from us_sim.errors import CaseError
from us_sim.settings.spelling import unknown
from us_sim.volume.cases.case import read_case
from us_sim.volume.cases.provenance import Step, add_step
from us_sim.volume.cases.settings import AROUND, CaseSettings
from us_sim.volume.cases.writing import changed_case, write_case_settings


def with_moduli(settings: CaseSettings, moduli: Mapping[str, float]) -> CaseSettings:
    """A case with these moduli (Pa) by structure, `AROUND` for what is in none.

    Raises:
        CaseError: there is no such structure.
        MaterialError: a modulus is out of range.
    """
    structures = dict(settings.structures)
    around = settings.around
    for name, modulus in moduli.items():
        if name not in (AROUND, *structures):
            raise CaseError(f"{settings.name}: structure {unknown(name, (AROUND, *structures))}")
        material = dataclasses.replace(settings.material_of(name), young_modulus=modulus)
        if name == AROUND:
            around = material
        else:
            structures[name] = dataclasses.replace(structures[name], material=material)
    return dataclasses.replace(settings, around=around, structures=structures)


def write_moduli_into(
    folder: str | os.PathLike[str], moduli: Mapping[str, float], step: Step
) -> None:
    """Write moduli (Pa) by structure into a case, and what was done for that.

    Raises:
        CaseError: there is no such case or structure, or it cannot be written.
    """
    settings = with_moduli(read_case(folder).settings, moduli)
    with changed_case(folder) as partial:
        write_case_settings(partial, settings)
        add_step(partial, step)
