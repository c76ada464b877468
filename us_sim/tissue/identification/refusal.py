"""Why a press does not determine moduli, in a sentence, and what would."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.tissue.identification.fit import Fitted
from us_sim.tissue.identification.identifiability import Verdict
from us_sim.tissue.identification.observations import Observations
from us_sim.tissue.identification.settings import StiffnessSettings

_UNITS = (("force", 1.0, "N"), ("torque", 1.0, "N m"), ("landmarks", 1e3, "mm"))


def refusal(
    names: Sequence[str],
    verdict: Verdict,
    observed: Observations,
    fitted: Fitted,
    settings: StiffnessSettings,
) -> str:
    """The sentence.

    Args:
        names: of P structures.
        verdict: on these.
        observed: the measurements.
        fitted: what they led to.
        settings: with which they are judged.
    """
    reasons, unknown = [], [p for p in range(len(names)) if not verdict.determined[p]]
    for p in unknown:
        if not verdict.felt[p]:
            reasons.append(f"{names[p]} hardly matters: {_effect(p, observed, fitted, settings)}")
        elif verdict.like[p]:
            others = " and ".join(names[other] for other in verdict.like[p][:3])
            reasons.append(f"{names[p]} cannot be told from {others}, which act alike")
        else:
            factor = np.exp(min(verdict.half_widths[p], 50.0))
            reasons.append(f"{names[p]} is known to a factor of {factor:.3g} only")
    those = " ".join(names[p] for p in unknown)
    known = [name for name, fine in zip(names, verdict.determined, strict=True) if fine]
    rest = f"; it does determine {', '.join(known)}" if known else ""
    return (
        f"this press does not determine {', '.join(names[p] for p in unknown)}: "
        f"{'; '.join(reasons)}{rest}; fix what it does not with --keep {those}, or press deeper, "
        f"from other sides, or nearer to it"
    )


def _effect(p: int, observed: Observations, fitted: Fitted, settings: StiffnessSettings) -> str:
    """What a stiffer structure would do, over the noise."""
    best, text = -1.0, ""
    for group, (name, scale, unit) in enumerate(_UNITS):
        its = observed.groups == group
        if not its.any():
            continue
        change = float(np.abs(fitted.jacobian[its, p]).max()) * np.log(settings.widest)
        noise = float(fitted.noise[its][0])
        if change / noise > best:
            best = change / noise
            text = (
                f"{settings.widest:g} times as stiff it would change the {name} by "
                f"{scale * change:.2g} {unit} at most, and their scatter is {scale * noise:.2g} "
                f"{unit}"
            )
    return text
