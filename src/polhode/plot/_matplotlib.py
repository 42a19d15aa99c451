"""matplotlib when it is there, a clear message when it is not, and the look of all figures."""

import functools

from polhode._extras import imported

X, Y, Z = "#D55E00", "#009E73", "#0072B2"  # body or space axes; told apart by the colour-blind
AXES = (X, Y, Z)
INK, GREY, PAPER, ACCENT = "#222222", "#8A8A8A", "#FFFFFF", "#C2185B"
STYLE = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 9.5,
    "axes.edgecolor": "#666666",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "figure.facecolor": PAPER,
    "savefig.dpi": 160,
}


def styled(function):
    """Run a plotting function with the common look, leaving the user's settings as they are."""

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        with imported("a figure", "matplotlib", extra="plot").rc_context(STYLE):
            return function(*args, **kwargs)

    return wrapper


def plain(text: str, length: int = 120) -> str:
    """A user's text as it stands: `$` begins no formula, control characters are written out."""
    from polhode.files._error import escape

    text = escape(text)
    text = text if len(text) <= length else text[: length - 4] + " ..."
    return text.replace("$", r"\$")


def new_figure(width: float, height: float):
    """A figure that belongs to pyplot, so that notebooks show it."""
    import matplotlib.pyplot as plt

    return plt.figure(figsize=(width, height), layout="constrained")
