"""Type-check user code: ``python tests/user_types.py`` runs mypy and pyright on the examples.

The examples are the Python blocks of README.md and of every page of docs/, each page one module.
Both checkers must accept them, and must reject a misspelt name.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MISSPELT = "import polhode as ph\n\nph.Simulate\n"


def pages() -> dict[str, str]:
    """Module name and code of every page with Python examples."""
    sources = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    blocks = {
        path.stem.lower(): re.findall(
            r"^```python\n(.*?)^```", path.read_text("utf-8"), re.S | re.M
        )
        for path in sources
    }
    return {name: "\n".join(code) for name, code in blocks.items() if code}


def checkers(folder: Path) -> dict[str, list[str]]:
    python = sys.executable
    return {
        "mypy": [python, "-m", "mypy", "--ignore-missing-imports", "--no-incremental", str(folder)],
        "pyright": [str(Path(python).with_name("pyright")), "--pythonpath", python, str(folder)],
    }


def main() -> int:
    failures = 0
    modules = pages()
    assert len(modules) > 5, f"examples of {len(modules)} pages only were found"
    with tempfile.TemporaryDirectory() as scratch:
        folder, wrong = Path(scratch) / "examples", Path(scratch) / "misspelt"
        folder.mkdir()
        wrong.mkdir()
        for name, code in modules.items():
            (folder / f"example_{name}.py").write_text(code, encoding="utf-8")
        (wrong / "misspelt.py").write_text(MISSPELT, encoding="utf-8")
        for name, command in checkers(folder).items():
            result = subprocess.run(command, capture_output=True, text=True, cwd=scratch)
            if result.returncode:
                failures += 1
                print(f"{name} rejects examples:\n{result.stdout}{result.stderr}")
        for name, command in checkers(wrong).items():
            result = subprocess.run(command, capture_output=True, text=True, cwd=scratch)
            if not result.returncode:
                failures += 1
                print(f"{name} accepts ph.Simulate, which does not exist")
    print(f"examples of {len(modules)} pages: {'rejected' if failures else 'accepted'}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
