"""What mkdocs is told beyond its files: generated pages, formulas without a script, the T-handle.

Reference pages list every public name, so that none is forgotten; notebooks are shown as they were
executed; formulas become MathML, which browsers draw by themselves: the site needs no network.
"""

import html
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import jax
import numpy as np
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

import polhode as ph
from polhode import plot

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = (
    "quick_start", "intermediate_axis", "euler_hamiltonian", "work_and_precision",
    "tumbling_asteroid", "explorer", "detumbling", "rotating_frames", "inertia", "fitting",
)  # fmt: skip
SECTIONS = {
    "Simulate": "simulate explain Scene State Trajectory Record Status SimulationError Plan choose",
    "Events": "Event crossings Crossings",
    "Methods": "ClosedForm LagrangeTop SymmetricTop FixedAxis LiePoisson EulerAngles",
    "Bodies": "Inertia MassProperties periods Periods Mode",
    "What acts": "UniformGravity GravityGradient AbstractOrbit KeplerOrbit StateOrbit Potential "
    "BodyTorque SpaceTorque FeedbackTorque LinearDamping QuadraticDamping EnergySink Pulses "
    "Pointing RateDamping MagneticDipole BDot DipoleField "
    "Rotor Motor ViscousCoupling CoulombFriction AbstractCoupling",
    "Frames and sensors": "LVLH RelativeTorque RotatingFrame simulate_particles "
    "accelerometer gyroscope",
    "The Hamiltonian": "hamiltonian hamiltons_equations",
    "From data": "fit_inertia fit_recordings fit_scene propagate Propagation",
}
"""Order of the names of ``polhode`` on its page; others follow under "More"."""


def public_modules() -> list[str]:
    """``polhode`` and its public submodules."""
    found = [m.name for m in pkgutil.iter_modules(ph.__path__) if not m.name.startswith("_")]
    return [
        "polhode",
        *(f"polhode.{name}" for name in sorted(found) if name not in ("cli", "parts")),
    ]


def public_names(module: str) -> list[str]:
    """What a module exports (``from a import b as b``), submodules left out, in its order."""
    holder = importlib.import_module(module)
    named = re.findall(r"\b(\w+) as \1\b", inspect.getsource(holder))
    things = [name for name in named if not inspect.ismodule(getattr(holder, name))]
    return things or named  # of a package of modules, those


def on_config(config):
    """Fill the navigation: notebooks, reference."""
    for part in config.nav:
        title = next(iter(part))
        if title == "Notebooks":
            part[title] = [f"notebooks/{name}.md" for name in _notebooks()]
        elif title == "Reference":
            part[title] = [{module: f"reference/{module}.md"} for module in public_modules()]
    return config


def _notebooks() -> list[str]:
    there = {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}
    return [*(n for n in NOTEBOOKS if n in there), *sorted(there - set(NOTEBOOKS))]


def on_files(files: Files, *, config) -> Files:
    """Add the pages that are made rather than written."""

    def add(path: str, content: str | bytes) -> None:
        files.append(File.generated(config, path, content=content))

    for module in public_modules():
        add(f"reference/{module}.md", _reference(module))
    for name in _notebooks():
        for path, content in _notebook(name).items():
            add(f"notebooks/{path}", content)
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    add("changelog.md", changes)
    add("benchmarks.md", _benchmarks(add))
    add("motion/t_handle.html", _t_handle())
    return files


def _reference(module: str) -> str:
    names = public_names(module)
    about = (importlib.import_module(module).__doc__ or "").strip()
    lines = [f"# {module}", "", about, ""]
    groups = {"": names}
    if module == "polhode":
        groups = {title: [n for n in row.split() if n in names] for title, row in SECTIONS.items()}
        shown = {name for row in groups.values() for name in row}
        groups["More"] = [name for name in names if name not in shown]
    for title, row in groups.items():
        if title and row:
            lines += [f"## {title}", ""]
        lines += [f"::: {module}.{name}\n" for name in row]
    return "\n".join(lines)


def _notebook(name: str) -> dict[str, str | bytes]:
    """The page and the pictures of an executed notebook."""
    body, resources = MarkdownExporter().from_filename(
        str(ROOT / "notebooks" / f"{name}.ipynb"), {"unique_key": name, "output_files_dir": name}
    )
    text = re.sub(r"\]\((\w+)\.ipynb\)", r"](\1.md)", body)
    text = re.sub(r"\]\(\.\./docs/([\w.]+)\)", r"](../\1)", text)
    text = re.sub(r"\[!\[(Open in Colab)\]\([^)]+\)\]", r"[\1]", text)  # no picture from elsewhere
    text = text.replace("](../benchmarks/README.md)", "](../benchmarks.md)")
    source = f"*This page is the executed notebook `notebooks/{name}.ipynb`.*"
    return {f"{name}.md": f"{text}\n\n{source}\n", **resources["outputs"]}


def _benchmarks(add) -> str:
    """The results page with its figures; links into the source become plain text."""
    folder = ROOT / "benchmarks"
    text = (folder / "README.md").read_text(encoding="utf-8")
    for figure in sorted(set(re.findall(r"\]\((results/[\w.]+\.svg)\)", text))):
        add(figure, (folder / figure).read_bytes())
    text = re.sub(r"\]\(\.\./docs/([\w.]+\.md)(#[\w-]+)?\)", r"](\1\2)", text)
    return re.sub(r"\[([^\]]+)\]\((?:\.\./(?!docs)|results/[\w.]+\.json)[^)]*\)", r"\1", text)


def _t_handle() -> str:
    """The T-handle of the front page: spun about its intermediate axis, it turns over."""
    jax.config.update("jax_enable_x64", True)
    bar = _cylinder(0.006, 0.10, axis=1, centre=[0.0, 0.0, 0.0])
    stem = _cylinder(0.005, 0.05, axis=0, centre=[0.031, 0.0, 0.0])
    handle = ph.MassProperties.from_mesh(*bar, density=2700.0)
    handle = handle + ph.MassProperties.from_mesh(*stem, density=2700.0)
    vertices = np.concatenate([bar[0], stem[0]]) - np.asarray(handle.centre)
    faces = np.concatenate([bar[1], stem[1] + len(bar[0])])
    state = ph.State(wxyz=[1.0, 0.0, 0.0, 0.0], omega_body=[8.0, 0.03, 0.03])
    moved = ph.simulate(ph.Scene(handle.inertia), state, np.linspace(0.0, 12.0, 1201))
    title = "A T-handle, spun about its intermediate axis"
    return plot.view(moved, mesh=(vertices, faces), title=title).html


def _cylinder(radius: float, length: float, axis: int, centre) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a cylinder along a body axis."""
    count = 48
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    end = np.array([0.0, 0.0, length / 2])
    vertices = np.concatenate([ring - end, ring + end, [-end, end]])
    vertices = np.roll(vertices, axis + 1, axis=1)  # from z to the axis
    i, j = np.arange(count), (np.arange(count) + 1) % count
    faces = [
        np.stack([i, j, i + count], -1), np.stack([j, j + count, i + count], -1),
        np.stack([j, i, np.full(count, 2 * count)], -1),
        np.stack([i + count, j + count, np.full(count, 2 * count + 1)], -1),
    ]  # fmt: skip
    return vertices + np.asarray(centre), np.concatenate(faces)


_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\s*(?:\\\((.*?)\\\)|\\\[(.*?)\\\])\s*</\1>', re.S
)


def on_page_markdown(markdown: str, **_) -> str:
    """Figures of benchmarks stand beside the page of results."""
    return markdown.replace("](../benchmarks/results/", "](results/")


def on_page_content(content: str, page, config, **_) -> str:
    """Formulas as MathML; pages that docstrings name as links."""

    def formula(match: re.Match) -> str:
        inline = match[2] is not None
        text = html.unescape(match[2] if inline else match[3]).strip()
        return convert(text, display="inline" if inline else "block")

    def link(match: re.Match) -> str:
        if not (Path(config.docs_dir) / f"{match[1]}.md").exists():
            raise PluginError(f"{page.file.src_path} names docs/{match[1]}.md, which is not there")
        return f'<a href="../{match[1]}.html">{match[0]}</a>'

    if page.file.src_path.startswith("reference/"):
        content = re.sub(r"\bdocs/(\w+)\.md\b", link, content)
    return _FORMULA.sub(formula, content)
