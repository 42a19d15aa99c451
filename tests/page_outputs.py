"""Execute the examples of the documentation and store their output: ``make examples``.

    python tests/page_outputs.py [PAGE ...]

A page is README.md or a Markdown file under docs/. The ``python`` blocks of a page run one after
another in one process. The ``output`` block after a block contains what it prints. Figures that a
block saves and the page shows are copied to docs/figures.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS, FIGURES = ROOT / "docs", ROOT / "docs" / "figures"
BLOCK = re.compile(
    r"^```python\n(.*?)^```\n(?:\n```output\n(.*?)^```\n)?", re.DOTALL | re.MULTILINE
)
FIGURE = re.compile(r"!\[[^\]]*\]\(\S*?figures/([\w.-]+)\)")

RUNNER = """
import contextlib, io, json, linecache, sys

scope, outputs = {"__name__": "__main__"}, []
with open("blocks.json", encoding="utf-8") as file:
    blocks = json.load(file)
for number, code in enumerate(blocks, 1):
    name, stream = f"block {number}", io.StringIO()
    linecache.cache[name] = (len(code), None, code.splitlines(True), name)
    with contextlib.redirect_stdout(stream):
        exec(compile(code, name, "exec"), scope)
    outputs.append(stream.getvalue())
with open("outputs.json", "w", encoding="utf-8") as file:
    json.dump(outputs, file)
"""


def pages() -> list[Path]:
    """README.md and the written pages of the documentation."""
    return [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


def name_of(page: Path) -> str:
    """The path of a page below docs/, without its suffix."""
    return page.stem if page.parent == ROOT else page.relative_to(DOCS).with_suffix("").as_posix()


def blocks(text: str) -> list[tuple[str, str]]:
    """Code and stored output of every example of a page."""
    return BLOCK.findall(text)


def figures(text: str) -> list[str]:
    """Names of the figures that a page shows."""
    return FIGURE.findall(text)


def executed(text: str, folder: Path) -> list[str]:
    """Run all examples of a page in ``folder``; what each of them prints."""
    (folder / "blocks.json").write_text(json.dumps([code for code, _ in blocks(text)]), "utf-8")
    (folder / "runner.py").write_text(RUNNER, "utf-8")
    paths = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "runner.py"],
        cwd=folder,
        env=os.environ | {"MPLBACKEND": "Agg", "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(done.stderr[-3000:])
    return json.loads((folder / "outputs.json").read_text("utf-8"))


def with_outputs(text: str, outputs: list[str]) -> str:
    """The text of the page with these outputs after its examples."""
    rest = iter(outputs)

    def example(match: re.Match) -> str:
        lines = (line.rstrip() for line in next(rest).strip("\n").splitlines())
        printed = "\n".join(lines)
        shown = f"\n```output\n{printed}\n```\n" if printed.strip() else ""
        return f"```python\n{match[1]}```\n{shown}"

    return BLOCK.sub(example, text)


def main(names: list[str]) -> None:
    for page in [Path(name).resolve() for name in names] or pages():
        text = page.read_text("utf-8")
        if not blocks(text):
            continue
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            page.write_text(with_outputs(text, executed(text, folder)), "utf-8")
            for figure in figures(text):
                if (folder / figure).exists():
                    FIGURES.mkdir(exist_ok=True)
                    shutil.copy(folder / figure, FIGURES / figure)
        print(page.relative_to(ROOT), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
