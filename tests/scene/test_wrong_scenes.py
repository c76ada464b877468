"""Every kind of mistake in every setting of a scene: one sentence with file, key and what is right.

The mistakes are made from the settings' own rules, so a new setting is tried without a word here.
"""

import copy
import dataclasses
import math
import pathlib
from collections.abc import Collection, Iterator, Mapping
from types import UnionType
from typing import Any, Union, get_args, get_origin

import pytest
import yaml

from us_sim.errors import SceneError
from us_sim.scene.reading import load_scene, parse_scene
from us_sim.scene.scene import Scene
from us_sim.settings.choice import Choice, Chosen
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Rule, Settings, kinds_of, rules_of

RIGHT = yaml.safe_load(
    """
name: right
volume: {phantom: upper_arm}
probe:
  aperture: 40 mm
  depth: 40 mm
  image: [64, 48]
  collider: {shape: sphere, radius: 2 cm}
tissue:
  mesh: {lower: [-20 mm, -20 mm, 0], upper: [20 mm, 20 mm, 40 mm], nodes: [3, 4, 5]}
  materials: {muscle: {young_modulus: 12 kPa}}
structures:
  vein: {}
  artery: {flow: {kind: venous, direction: [0, 1, 0], peak_velocity: 0.3, mean_velocity: 0.1}}
skin: {}
imaging: {acoustics: {tissues: {muscle: {fibres: [0, 1, 0]}}}}
"""
)

Path = tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Place:
    """A mapping of a right scene, and the settings that are its keys."""

    document: dict[str, Any]
    path: Path
    settings: type[Settings]
    choice: Choice | None = None  # of which the settings are an option's, if they are
    option: str = ""

    @property
    def name(self) -> str:
        """For a person."""
        return ".".join(self.path) + (f" ({self.option})" if self.choice else "")

    def with_value(self, key: str, value: object) -> dict[str, Any]:
        """The scene with a value under a key of this place."""
        return put(self.document, (*self.path, key), value)


@dataclasses.dataclass(frozen=True)
class Mistake:
    """A wrong scene, the keys that lead to what is wrong, and facts that its sentence has."""

    what: str
    document: object
    key: str
    words: tuple[str, ...] = ()


def put(document: dict[str, Any], path: Path, value: object) -> dict[str, Any]:
    """A copy with a value at a path of keys, mappings being made on the way."""
    made = copy.deepcopy(document)
    section = made
    for key in path[:-1]:
        if not isinstance(section.get(key), dict):
            section[key] = {}
        section = section[key]
    section[path[-1]] = value
    return made


def at(document: Any, path: Path) -> Any:
    """The value at a path of keys, or None."""
    for key in path:
        document = document.get(key) if isinstance(document, dict) else None
    return document


def options_of(kind: Any) -> tuple[Any, ...]:
    """The types that a value may have, without None."""
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    return tuple(option for option in options if option is not type(None))


def right_value(kind: Any, rule: Rule) -> Any:
    """A value that will do, not the one by default."""
    kind = options_of(kind)[0]
    if kind is bool:
        return True
    if kind is str:
        return (rule.choice.names if rule.choice else rule.choices or ("some text",))[-1]
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        count = 2 if kinds[-1] is Ellipsis else len(kinds)
        return [right_value(kinds[0], rule)] * count
    quantity = rule.quantity or Quantity("number", 0.0, 10.0)
    low, high = quantity.minimum, quantity.maximum
    middle = math.sqrt(low * high) if low > 0 else low + 0.6 * (high - low)
    return round(middle) if kind is int else middle


def required(settings: type[Settings]) -> dict[str, Any]:
    """Values of the settings that have no default."""
    rules, kinds = rules_of(settings), kinds_of(settings)
    missing = dataclasses.MISSING
    fields = {field.name: field for field in dataclasses.fields(settings)}
    return {
        name: right_value(kinds[name], rules[name])
        for name in rules
        if fields[name].default is missing and fields[name].default_factory is missing
    }


def places(place: Place) -> Iterator[Place]:
    """A place, and all those below it, of all options of all choices."""
    yield place
    document = place.document
    for name, rule in rules_of(place.settings).items():
        path = (*place.path, name)
        for kind in options_of(kinds_of(place.settings)[name]):
            if kind is Chosen:
                yield from chosen_places(place, name, rule)
            elif get_origin(kind) in (dict, Mapping) and rule.choice:
                for option in rule.choice.names:
                    settings = rule.choice.settings(option)
                    below = put(document, (*path, option), {})
                    yield from places(Place(below, (*path, option), settings))
            elif get_origin(kind) in (dict, Mapping):
                inner = get_args(kind)[1]
                if isinstance(inner, type) and issubclass(inner, Settings):
                    label = next(iter(at(document, path)))
                    yield from places(Place(document, (*path, label), inner))
            elif isinstance(kind, type) and issubclass(kind, Settings):
                below = document if at(document, path) else put(document, path, required(kind))
                if name == "pose" and place.path != ("volume",):
                    continue  # a pose is for what is from a file only
                yield from places(Place(below, path, kind))


def chosen_places(place: Place, name: str, rule: Rule) -> Iterator[Place]:
    """The places that are there when each of the options is chosen."""
    choice = rule.choice
    assert choice is not None
    for option in choice.names:
        settings = choice.settings(option)
        if rule.place == "within":
            path = (*place.path, name)
            below = put(place.document, path, {choice.key: option, **required(settings)})
        elif rule.place == "beside":
            path = place.path
            own = {
                key: (at(place.document, path) or {}).get(key) for key in rules_of(place.settings)
            }
            kept = {key: value for key, value in own.items() if value is not None}
            below = put(place.document, path, kept | {choice.key: option, **required(settings)})
        else:
            path = (*place.path, option)
            below = put(put(place.document, path, {}), (*place.path, choice.key), option)
        yield from places(Place(below, path, settings, choice, option))


PLACES = {place.name: place for place in places(Place(RIGHT, (), Scene))}


def mistakes(place: Place) -> Iterator[Mistake]:
    """Everything that can be wrong with a mapping of settings."""
    yield from unknown_keys(place)
    needed = required(place.settings)
    for name in needed:
        document = copy.deepcopy(place.document)
        del at(document, place.path)[name]
        yield Mistake("missing", document, ".".join((*place.path, name)))
    for name, rule in rules_of(place.settings).items():
        if rule.place == "within":
            kind, *others = options_of(kinds_of(place.settings)[name])
            for what, value, index, words in wrong_values(kind, rule, others):
                key = ".".join((*place.path, name)) + index
                yield Mistake(f"{what}: {value!r}", place.with_value(name, value), key, words)
        if rule.file:
            yield missing_file(place, name, rule)
    yield from not_here(place)


def missing_file(place: Place, name: str, rule: Rule) -> Mistake:
    """A file that is not there, in a mapping that says nothing else but what the file needs."""
    mapping = {name: "qqqq.yaml"}
    if rule.applies:
        mapping[rule.applies[0]] = rule.applies[1][0]
    document = put(place.document, place.path, mapping) if place.path else place.document | mapping
    return Mistake("file", document, ".".join((*place.path, name)), ("qqqq.yaml",))


def unknown_keys(place: Place) -> Iterator[Mistake]:
    """Each key with a letter missing, and one that is like none."""
    rules = rules_of(place.settings)
    known = {name for name, rule in rules.items() if not rule.choice or rule.place == "within"}
    known |= {rule.choice.key for rule in rules.values() if rule.choice and rule.place != "within"}
    for name in known:
        letter = len(name) // 2
        wrong = name[:letter] + name[letter + 1 :]
        document = place.with_value(wrong, at(place.document, (*place.path, name)))
        key = ".".join((*place.path, wrong))
        yield Mistake("misspelt key", document, key, (f"`{name}`",))
    document = place.with_value("qqqq", 1)
    yield Mistake("no such key", document, ".".join((*place.path, "qqqq")))


Wrong = Iterator[tuple[str, object, str, tuple[str, ...]]]
"""A fault, a wrong value, the keys in it to the fault, and facts of the sentence."""


def wrong_values(kind: Any, rule: Rule, others: Collection[Any] = ()) -> Wrong:
    """Values that will not do for a type; ``others`` will do too."""
    if kind is bool:
        for value in (1, "yes", None, [True]):
            yield "not a truth", value, "", ("true", "false")
    elif kind is str:
        yield from wrong_texts(rule)
    elif get_origin(kind) is tuple:
        kinds = get_args(kind)
        for value in () if others else (3, "text", {"a": 1}):
            yield "not a list", value, "", ("list",)
        good = right_value(kind, rule)
        if kinds[-1] is not Ellipsis:
            for value in (good[1:], [*good, good[0]]):
                yield "list's length", value, "", (f" {len(kinds)} ",)
        for what, value, index, words in wrong_values(kinds[0], rule):
            yield f"item, {what}", [good[0], value, *good[2:]], f"[1]{index}", words
    elif kind in (int, float):
        yield from wrong_numbers(kind, rule.quantity or Quantity("number"))
    elif kind is Chosen:
        assert rule.choice is not None
        yield from wrong_choice(rule.choice)
    elif get_origin(kind) in (dict, Mapping):
        yield "not a mapping", 3, "", ("mapping",)
        if rule.choice:
            name = rule.choice.names[-1]
            yield "misspelt", {name[1:]: {}}, f".{name[1:]}", (f"`{name}`",)
    elif issubclass(kind, Settings):
        for value in (3, True, ["text"], *([] if str in others else ["text"])):
            yield "not a mapping", value, "", ("mapping",)


def wrong_numbers(kind: type, quantity: Quantity) -> Wrong:
    """Values that will not do for a number of a quantity."""
    low, high, unit = quantity.minimum, quantity.maximum, quantity.unit
    named = f" {quantity.dimension}"
    foreign = "1 mm" if quantity.dimension != "length" else "1 kPa"
    yield "unit", foreign, "", (named, f" {unit}")
    for value in ("text", True, {"a": 1}):
        yield "type", value, "", (named,)
    within = f"{low:g} to {high:g}"
    for value in (math.nan, math.inf, -math.inf):
        yield "not finite", value, "", ("finite", within)
    for value in (low - max(1.0, abs(low)), high + max(1.0, abs(high))):
        if math.isfinite(value):
            wrong = int(value) if kind is int else value
            yield "range", wrong, "", (within,)
            written = f"{wrong!r} {unit}".strip()
            yield "range", written, "", (within,)
    if kind is int and math.isfinite(low):
        yield "not whole", low + 0.5, "", ("whole number",)


def wrong_texts(rule: Rule) -> Wrong:
    """Values that will not do for a text."""
    names = rule.choice.names if rule.choice else rule.choices
    for value in (5, True, ["text"], {"a": 1}):
        yield "not a text", value, "", ("text",)
    if names:
        name = max(names, key=len)
        wrong = name[:-2] + name[-1]
        yield "choice", wrong, "", (f"'{name}'",)
        yield "choice", "qqqq", "", ("'qqqq'", ", ".join(names))
        yield "empty", "", "", ("''", ", ".join(names))
    else:
        yield "empty", "", "", ("empty",)


def wrong_choice(choice: Choice) -> Wrong:
    """Values that will not do for a mapping that says what is chosen."""
    name = max(choice.names, key=len)
    wrong = name[1:]
    key = choice.key
    yield "choice", {key: wrong}, f".{key}", (f"'{name}'",)
    yield "choice", {key: 5}, f".{key}", ("5", ", ".join(choice.names))
    yield "no choice", {}, f".{key}", (", ".join(choice.names),)
    yield "misspelt", {key[1:]: name}, f".{key[1:]}", (f"`{key}`",)
    for value in (3, name, [name]):
        yield "not a mapping", value, "", ("mapping",)


def not_here(place: Place) -> Iterator[Mistake]:
    """Keys that only other options have, or that go with other values of another setting."""
    if place.choice is not None and place.option not in place.path:
        own = rules_of(place.settings)
        for other in place.choice.names:
            settings = place.choice.settings(other)
            for name in rules_of(settings).keys() - own.keys():
                value = right_value(kinds_of(settings)[name], rules_of(settings)[name])
                key = ".".join((*place.path, name))
                words = (place.option, name, other)
                yield Mistake("other's", place.with_value(name, value), key, words)
    for name, rule in rules_of(place.settings).items():
        chosen = kinds_of(place.settings)[name] is Chosen
        if chosen and rule.choice and rule.place == "named":
            mine, *others = rule.choice.names
            for other in others:
                document = put(place.document, (*place.path, rule.choice.key), mine)
                document = put(document, (*place.path, other), {})
                key = ".".join((*place.path, other))
                yield Mistake("other's", document, key, (rule.choice.key, mine))
        if rule.applies:
            with_, values = rule.applies
            options = rules_of(place.settings)[with_].choice or rules_of(place.settings)[with_]
            names = options.names if isinstance(options, Choice) else options.choices
            for other in set(names) - set(values):
                value = right_value(kinds_of(place.settings)[name], rule)
                document = put(place.with_value(name, value), (*place.path, with_), other)
                if rule.file:
                    document = put(document, (*place.path, name), __file__)
                key = ".".join((*place.path, name))
                yield Mistake("does not apply", document, key, (with_, *values, other))


def complaint(mistake: Mistake) -> str:
    """The fault of the sentence about a mistake, '' if there is none."""
    what = f"{mistake.what} at {mistake.key}"
    try:
        parse_scene(mistake.document, origin="my.yaml")
    except SceneError as error:
        said = str(error)
        right = said.startswith(f"my.yaml: {mistake.key}: ") and "\n" not in said
        if right and all(words in said for words in mistake.words):
            return ""
        return f"{what}, {mistake.words}: {said}"
    except Exception as error:
        return f"{what}: {error!r}"
    return f"{what}: accepted"


def test_the_scenes_are_right_before_a_mistake_is_made():
    assert len(PLACES) > 30
    for place in PLACES.values():
        parse_scene(place.document, origin=place.name)


@pytest.mark.parametrize("place", PLACES)
def test_each_mistake_is_one_sentence_with_file_and_key_and_what_is_right(place):
    made = list(mistakes(PLACES[place]))
    complaints = [said for said in map(complaint, made) if said]
    assert not complaints, f"{len(complaints)} of {len(made)}:\n" + "\n".join(complaints)


def scene_text(**sections: str) -> str:
    """The YAML of a right scene, with these sections instead of its own."""
    document = {key: value for key, value in RIGHT.items() if key not in sections}
    return yaml.safe_dump(document) + "".join(f"{k}: {v}\n" for k, v in sections.items())


def refusal_of(file: pathlib.Path, where: str) -> str:
    """The one sentence of the error about a scene file; it begins with the file and a place."""
    with pytest.raises(SceneError) as caught:
        load_scene(file)
    said = str(caught.value)
    assert said.startswith(": ".join([str(file), *([where] if where else []), ""]))
    assert "\n" not in said
    return said


@pytest.mark.parametrize(
    ("section", "text", "key", "fact"),
    [
        ("slice", "{method: scan_conversion, regions: 4}", "slice.regions", "row_subdivision"),
        ("tracker", "{source: camera, camera: {}, haptic: {}}", "tracker.haptic", "camera"),
        ("structures", "[vein, vein]", "structures[1]", "vein"),
        ('"qq\\nqq"', "3", "'qq\\nqq'", ""),
        ("probe", "[" + "12345, " * 99 + "]", "probe", "12345"),
    ],
)
def test_a_mistake_in_a_file_is_one_short_sentence(tmp_path, section, text, key, fact):
    file = tmp_path / "mine.yaml"
    file.write_text(scene_text(**{section: text}))
    said = refusal_of(file, key)
    assert fact in said
    assert len(said) < len(str(file)) + 250


@pytest.mark.parametrize(
    ("text", "where"),
    [
        *((text, "") for text in ("name: 2001-99-99", "name: !!int text", "name: \x07")),
        ("name: !!python/object/apply:os.getcwd []", "line 1: "),
        ("{[1]: 2}", "line 1: "),
        ("&a name: &b {c: *b}", "line 1: "),
        ("name: a\n name: b", "line 2: "),
    ],
)
def test_a_file_that_is_no_yaml_is_one_sentence_with_its_line(tmp_path, text, where):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    refusal_of(file, where.removesuffix(": "))


def test_a_long_chain_of_scenes_is_refused(tmp_path):
    for number in range(1200):
        (tmp_path / f"{number}.yaml").write_text(f"based_on: {number + 1}.yaml\n")
    with pytest.raises(SceneError, match=r"based_on: .*/0\.yaml.* 20 "):
        load_scene(tmp_path / "0.yaml")
