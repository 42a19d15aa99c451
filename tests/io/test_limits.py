"""Files designed to overload or break the parser: rejected at once, with the position named."""

import pytest

from polhode.files import SceneFileError, parse_scene, read_scene

HEAD = "[inertia]\nmoments = [1.0, 2.0, 2.5]\n"


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("text", "hints"),
    [
        (HEAD + "x" + ".a" * 5000 + " = 1", ["nested too deeply", "line 3"]),
        (HEAD + "[x" + " . a" * 50_000 + "]", ["nested too deeply"]),
        ("[inertia]\nmoments = " + "[" * 100_000, ["not valid TOML", "brackets nested too deeply"]),
        ("[inertia]\nmoments = " + "{a=" * 3000, ["not valid TOML", "brackets nested too deeply"]),
        ("[times]\nnumber = " + "9" * 5000, ["not valid TOML", "4300 digits"]),
        ("[times]\nnumber = 0x" + "f" * 50_000, ["[times] number", "less than or equal"]),
        ("[times]\nnumber = 0x" + "f" * 3900, ["[times] number", "less than or equal"]),
        ("a" * 100_000 + " = 1", ["aaa ...", "Extra inputs"]),
        ("title = '''" + "\n[" * 50, ["not valid TOML"]),
        ('title = "' + "\\u0000" * 10 + '"\n' + HEAD, ["state", "Field required"]),
    ],
)
def test_what_would_take_the_parser_long_is_refused_at_once(text, hints):
    with pytest.raises(SceneFileError) as caught:
        parse_scene(text, "big.toml")
    message = str(caught.value)
    assert message.startswith("big.toml: ")
    assert len(message) < 700
    for hint in hints:
        assert hint in message


def test_what_is_in_texts_and_comments_is_not_nested():
    text = HEAD + "# [[[[[[[[[[[[[[[[[[[[[[[\n[state]\nomega_body = [0, 1, 0]\n[times]\nstop = 1\n"
    text = 'title = "' + "[{" * 40 + ".a" * 150 + '\\""\n' + text + "number = 2\n"
    assert parse_scene(text, "a.toml").title.startswith("[{[{")


def test_a_file_without_an_end_is_refused(tmp_path):
    with pytest.raises(SceneFileError, match="too large"):
        read_scene("/dev/zero")
    big = tmp_path / "big.toml"
    big.write_bytes(b"#" * 2**24 + b"#\n")
    with pytest.raises(SceneFileError, match="too large"):
        read_scene(big)
    with pytest.raises(SceneFileError, match="null byte"):
        read_scene("a\0b")


def test_the_schema_and_the_page_name_the_same_keys():
    """docs/scene_files.md contains every key of the schema, and a scene of every kind validates."""
    import re
    from pathlib import Path

    from polhode.files import SceneFile

    schema = SceneFile.model_json_schema()
    tables = [schema, *schema["$defs"].values()]
    keys = {key for table in tables for key in table.get("properties", {})}
    page = (Path(__file__).parents[2] / "docs" / "scene_files.md").read_text()
    words = set(re.findall(r"\w+", " ".join(re.findall(r"`+[^`]+`+", page, re.DOTALL))))
    assert len(keys) > 70
    assert keys - words == set()
    # also choices: shapes, kinds, units
    choices = {
        c
        for t in tables
        for p in t.get("properties", {}).values()
        for c in (*p.get("enum", ()), p.get("const"))
    } - {None}
    choices = {c for c in choices if isinstance(c, str)}
    choices = {c for c in choices if len(c) > 3 or c.isalpha()} - {
        a for a in choices if len(a) == 3 and set(a) <= set("XYZ")
    }
    assert {c for c in choices if c not in page} == set()
    assert schema["additionalProperties"] is False
