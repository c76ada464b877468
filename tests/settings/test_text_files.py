"""YAML that is too large or too deep, or has a key twice, is refused."""

import pytest

from us_sim.settings.text_files import LARGEST_YAML, YamlError, load_yaml


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("[" * 100_000 + "]" * 100_000, "YAML"),
        ("a: 'x" + "x" * LARGEST_YAML + "'", str(LARGEST_YAML)),
        ("a: 1\nb: 2\na: 3", "line 3: .*`a`.*line 1"),
        ("x: &x {a: 1}\ny: {<<: *x, <<: *x}", "line 2: .*`<<`"),
        *((text, "YAML") for text in ("!!timestamp foo", "!!int ''", "? [a]\n: b")),
    ],
)
def test_what_nobody_writes_by_hand_is_refused(text, fact):
    with pytest.raises(YamlError, match=fact):
        load_yaml(text)


def test_what_people_write_is_read():
    text = "base: &base {depth: 4 cm, lines: 128}\nprobe: {<<: *base, depth: 6 cm}\n"
    assert load_yaml(text)["probe"] == {"depth": "6 cm", "lines": 128}
    assert load_yaml("a: [1, 2.5, ~, true]") == {"a": [1, 2.5, None, True]}
    assert load_yaml("") is None
    assert load_yaml("[" * 60 + "]" * 60)
