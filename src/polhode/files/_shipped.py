"""The scene files that come with polhode."""

from pathlib import Path

_FOLDER = Path(__file__).with_name("scenes")


def shipped_scenes() -> dict[str, Path]:
    """The scene files that come with polhode, by name (``polhode run NAME`` runs one)."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.toml"))}
