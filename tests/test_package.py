"""Metadata of the package: types, version, licences, links, interpreters, lowest versions."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import versions

import polhode

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
WORKFLOWS = ROOT / ".github" / "workflows"


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_wheel_says_that_it_is_typed_and_holds_every_module(tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(tmp_path)]
    subprocess.run([*command, str(ROOT)], check=True, capture_output=True, timeout=300)
    (wheel,) = tmp_path.glob("*.whl")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("polhode/")}
    assert "polhode/py.typed" in held
    source = ROOT / "src"
    assert "polhode/__init__.pyi" in held
    assert held >= {str(path.relative_to(source)) for path in (source / "polhode").rglob("*.py")}


def test_the_mark_stands_beside_the_modules():
    assert Path(polhode.__file__).with_name("py.typed").exists()


@pytest.mark.parametrize(("tag", "code"), [(f"v{polhode.__version__}", 0), ("v99.0", 1)])
def test_the_release_workflow_compares_tag_and_version(tag, code):
    """The test runs the line of the workflow in the folder in which the workflow runs it."""
    text = (WORKFLOWS / "release.yml").read_text(encoding="utf-8")
    (line,) = re.findall(r"- name: the tag is the version\n +run: (.+)\n", text)
    environment = os.environ | {"GITHUB_REF_NAME": tag}
    assert subprocess.run(["bash", "-c", line], cwd=ROOT, env=environment).returncode == code


def test_workflows_and_make_name_files_that_exist():
    texts = [path.read_text(encoding="utf-8") for path in WORKFLOWS.glob("*.yml")]
    for text in [*texts, read("Makefile")]:
        for name in re.findall(r"\b(?:src|tests|docs|scenes|notebooks)/[\w/.]+\.\w+", text):
            assert (ROOT / name).exists(), name


def test_the_version_stands_in_one_place():
    """`polhode --version` is fast because it does not read the metadata of the installation."""
    assert "version" in PROJECT["dynamic"]
    found = re.findall(r'^__version__ = "(.+)"$', read("src/polhode/__init__.py"), re.M)
    assert found == [polhode.__version__]
    assert PYPROJECT["tool"]["hatch"]["version"]["path"] == "src/polhode/__init__.py"
    sources = [path for path in (ROOT / "src").rglob("*.py") if path.name != "__init__.py"]
    assert not [path for path in sources if polhode.__version__ in path.read_text("utf-8")]


def test_the_citation_is_of_this_version():
    citation = dict(re.findall(r"^([\w-]+): *(.*)$", read("CITATION.cff"), re.M))
    assert citation["version"] == polhode.__version__
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", citation["date-released"])
    assert citation["repository-code"] == PROJECT["urls"]["Repository"]
    assert PROJECT["authors"][0]["name"] in read("CITATION.cff")
    assert all(
        f"  - {name}\n" in read("CITATION.cff") for name in PROJECT["license"].split(" AND ")
    )


def test_every_interpreter_that_is_named_is_tested():
    named = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)}
    tested = set(re.findall(r'python: "(3\.\d+)"', (WORKFLOWS / "tests.yml").read_text("utf-8")))
    assert named == tested
    assert PROJECT["requires-python"] == f">={min(named)}"


def test_licences_are_named_and_there():
    assert PROJECT["license"] == "Apache-2.0 AND MIT"
    texts = [read(name) for name in PROJECT["license-files"]]
    assert "Apache License" in texts[0]
    assert "three.js authors" in texts[1]


def test_the_readme_of_the_package_index_has_absolute_links():
    text = read("README.md")
    hook = PYPROJECT["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    for rule in hook["substitutions"]:
        text = re.sub(rule["pattern"], rule["replacement"], text)
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) > 30
    assert not [link for link in links if not link.startswith(("https://", "#"))]
    figures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    raw = "https://raw.githubusercontent.com/polhode/polhode/main/"
    assert figures
    assert all((ROOT / figure.removeprefix(raw)).exists() for figure in figures)


def test_the_lowest_set_holds_every_dependency():
    floors = {floor.partition("==")[0] for floor in versions.floors()}
    assert {"jax", "jaxlib", "typer", "h5py", "matplotlib", "zarr", "trimesh"} <= floors
