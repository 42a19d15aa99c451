"""The tables of docs/scale.md agree with the committed results."""

from pathlib import Path

from benchmarks.scale import model


def test_tables_are_those_of_the_results():
    page = (Path(__file__).resolve().parents[2] / "docs" / "scale.md").read_text()
    table = page.split("<!-- model -->\n")[1].split("<!-- end -->")[0]
    assert table.strip() == model().strip()
