"""Settings as tables: every key of every kind of setting, and where its own keys are told."""

from collections.abc import Mapping
from dataclasses import dataclass

from us_sim.settings.choice import Choice, Chosen
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.settings.tables import anchor, sections_of, table


@dataclass(frozen=True)
class Round(Settings):
    """A round bottom."""

    radius: float = setting(Quantity("length", 0.01, 1.0), "of the bottom")


@dataclass(frozen=True)
class Flat(Settings):
    """A flat bottom."""


BOTTOMS = Choice("bottom", key="shape", round=f"{__name__}:Round", flat=f"{__name__}:Flat")
"""Its options are found without an import: they are replaced below by what is here."""
BOTTOMS.settings = {"round": Round, "flat": Flat}.__getitem__  # type: ignore[method-assign]
BOTTOMS.load = BOTTOMS.settings  # type: ignore[method-assign]


@dataclass(frozen=True)
class Fish(Settings):
    """A ``fish``."""

    length: float = setting(Quantity("length", 1e-3, 1.0), "of the fish", default=0.05)


@dataclass(frozen=True)
class Tank(Settings):
    """A tank."""

    depth: float = setting(Quantity("length", 0.01, 2.0), "of the water")
    size: tuple[float, float] = setting(Quantity("length", 0.1, 2.0), default=(0.5, 1.0))
    fish: Mapping[str, Fish] = setting(description="in it", default_factory=dict)
    bottom: Chosen = setting(description="below", choice=BOTTOMS, default=Chosen("flat"))
    plan: str | None = setting(description="drawn", default=None, file=True)
    light: str = setting(choices=("on", "off"), default="on")
    hours: int = setting(Quantity("number", 1, 24), default=8, applies=("light", ("on",)))


def test_a_row_for_each_setting():
    assert table(Tank, "tank").splitlines()[2:] == [
        "| `depth` | 10 mm to 2 m | needed | of the water |",
        "| `size` | list of 2, each 100 mm to 2 m | [500 mm, 1 m] |  |",
        "| `fish` | by name: [keys](#tankfishname) | none | in it |",
        "| `bottom` | [bottom](#tankbottom) | `flat` | below |",
        "| `plan` | file | none | drawn |",
        "| `light` | `on` or `off` | `on` |  |",
        "| `hours` | whole number 1 to 24 | 8 | only with `light` `on` |",
    ]


def test_a_section_for_all_that_has_keys_of_its_own():
    sections = list(sections_of(Tank, "tank"))
    assert [section.title for section in sections] == [
        "tank",
        "tank.fish.NAME",
        "tank.bottom",
        "tank.bottom with shape: round",
    ]
    assert sections[1].text.startswith("A `fish`.\n\n| key |")
    assert sections[2].text.splitlines()[2:] == [
        f"| `round` | A round bottom. | [keys](#{anchor(sections[3].title)}) |",
        "| `flat` | A flat bottom. | none |",
    ]
