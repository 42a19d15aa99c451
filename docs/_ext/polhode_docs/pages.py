"""Pages that are made from other files of the repository: notebooks, the animated T-handle."""

import base64
import json
import re
from pathlib import Path

from pygments.lexers.special import TextLexer

from polhode_docs.t_handle import t_handle

ROOT = Path(__file__).resolve().parents[3]
BADGE = re.compile(r"\[!\[Open in Colab\]\([^)]+\)\]")  # its picture comes from the network


def write_if_changed(path: Path, text: str) -> None:
    """Leave an unchanged page alone, so that it is not read again."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def remove_others(folder: Path, names: set[str]) -> None:
    """Remove the pages of an earlier build that are not in `names`."""
    for path in folder.glob("*"):
        if path.is_file() and path.name not in names:
            path.unlink()


def write_notebooks(app) -> None:
    """Copy the executed notebooks beside the pages, links adapted."""
    folder = Path(app.srcdir) / "notebooks"
    notebooks = sorted((ROOT / "notebooks").glob("*.ipynb"))
    for path in notebooks:
        book = json.loads(path.read_text(encoding="utf-8"))
        for cell in book["cells"]:
            if cell["cell_type"] == "markdown":
                cell["source"] = page_links("".join(cell["source"]))
        write_if_changed(folder / path.name, json.dumps(book, indent=1, ensure_ascii=False))
        thumbnail = first_figure(book)
        if thumbnail is not None:
            folder.joinpath(f"{path.stem}.png").write_bytes(thumbnail)
    remove_others(
        folder, {f"{path.stem}{kind}" for path in notebooks for kind in (".ipynb", ".png")}
    )


def first_figure(book: dict) -> bytes | None:
    """The first PNG among the outputs of a notebook, its thumbnail in the gallery."""
    for cell in book["cells"]:
        for output in cell.get("outputs", []):
            picture = output.get("data", {}).get("image/png")
            if picture:
                return base64.b64decode("".join(picture))
    return None


def page_links(text: str) -> str:
    """Markdown of a notebook as it stands in the documentation."""
    text = BADGE.sub("[Open in Colab]", text)
    text = text.replace("](../benchmarks/README.md", "](../benchmarks.md")
    return text.replace("](../docs/", "](../")


def adapt_links(app, document, source) -> None:
    """Links of a page, which lead to files of the repository, lead to pages of the site."""
    up = "../" if "/" in document else ""  # a folder down
    text = source[0].replace(f"]({up}../notebooks/", f"]({up}notebooks/")
    text = text.replace(f"]({up}../benchmarks/README.md", f"]({up}benchmarks.md")
    text = text.replace(f"]({up}../src/polhode/__init__.pyi", f"]({up}reference/index.rst")
    source[0] = with_thumbnails(text) if document == "gallery" else text


def with_thumbnails(text: str) -> str:
    """The tables of the gallery with the first figure of each notebook above its title."""

    def with_figures(row: re.Match) -> str:
        figures = re.sub(r"\[[^]]+\]\((\S+)\.ipynb\)", r"[![](\1.png)](\1.ipynb)", row[0])
        return f"{figures}\n{row[0]}"

    return re.sub(r"^\| \[.*", with_figures, text, flags=re.MULTILINE)


def write_motion(app, error) -> None:
    """The animation of the front page."""
    if error is None and app.builder.format == "html":
        write_if_changed(Path(app.outdir) / "motion" / "t_handle.html", t_handle())


def setup(app):
    app.connect("builder-inited", write_notebooks)
    app.connect("source-read", adapt_links)
    app.add_lexer("output", TextLexer)
    app.connect("build-finished", write_motion)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
