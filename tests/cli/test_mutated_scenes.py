"""Scene files with random mistakes: one message and an exit code, no traceback, no hang."""

import random
import re
from pathlib import Path

import pytest

from polhode.cli import main
from polhode.files import SceneFileError, build_scene, build_state, parse_scene, shipped_scenes

PAGE = Path(__file__).parents[2] / "docs" / "scene_files.md"
SCENES = [path.read_text("utf-8") for path in shipped_scenes().values()]
SCENES += re.findall(r"^```toml\n(.*?)^```", PAGE.read_text("utf-8"), re.S | re.M)
VALUES = [
    "0",
    "-1",
    "1e308",
    "nan",
    "inf",
    "true",
    '""',
    '"x"',
    "[]",
    "{}",
    "[[]]",
    "2020-01-01",
    "99999999999999999999",
    "[1, 2]",
    "[0, 0, 0]",
    '["a", 1]',
    "-0.0",
    "1e-320",
]


def mutated(text: str, seed: int) -> str:
    """A scene with one to three mistakes."""
    numbers = random.Random(seed)
    for _ in range(numbers.randint(1, 3)):
        lines = text.split("\n")
        at, kind = numbers.randrange(len(lines)), numbers.randrange(9)
        place = numbers.randrange(len(text) + 1)
        match kind:
            case 0:
                del lines[at]
            case 1:
                lines.insert(at, lines[numbers.randrange(len(lines))])
            case 2 if "=" in lines[at]:
                lines[at] = lines[at].split("=")[0] + "= " + numbers.choice(VALUES)
            case 3:
                lines[at] = lines[at].replace("=", numbers.choice([":", "==", " ", ".x ="]))
            case 4:
                numbers.shuffle(lines)
            case 5 if "=" in lines[at]:
                key, _, rest = lines[at].partition("=")
                lines[at] = key.strip()[::-1] + " =" + rest
            case 6:
                lines[at] = re.sub(r"\d", lambda _: str(numbers.randrange(10)), lines[at])
            case 7:
                lines = [text[:place] + chr(numbers.randrange(0x2FF)) + text[place + 1 :]]
            case _:
                lines = [text[:place]]
        text = "\n".join(lines)
    return text


@pytest.mark.timeout(600)
@pytest.mark.filterwarnings("ignore")
def test_five_hundred_mutated_scenes(tmp_path, monkeypatch):
    """Read and build each; every problem is a SceneFileError of a few printable lines."""
    refused = 0
    for seed in range(500):
        text = mutated(SCENES[seed % len(SCENES)], seed)
        try:
            file = parse_scene(text, "mutated.toml")
            build_state(file, "float64", build_scene(file, "float64").inertia)
        except SceneFileError as error:
            refused += 1
            message = str(error)
            assert message.startswith("mutated.toml: "), seed
            assert len(message) < 1200, seed
            assert message.replace("\n", "").isprintable(), seed
    assert 250 < refused < 500


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(0, 500, 50))
def test_mutated_scenes_through_the_command_line(tmp_path, monkeypatch, capsys, first):
    monkeypatch.chdir(tmp_path)
    for seed in range(first, first + 50):
        Path("mutated.toml").write_text(mutated(SCENES[seed % len(SCENES)], seed), "utf-8")
        assert main(["explain", "mutated.toml"]) in (0, 1, 2), seed
        told = capsys.readouterr()
        assert "Traceback" not in told.err, seed
        assert "--debug" not in told.err, (seed, told.err)  # the message of an unexpected error
