"""Numbers, tables and lines on machines as the pages show them."""


def number(value: float | None, unit: float = 1.0) -> str:
    """Three digits, or a dash."""
    if value is None:
        return "–"
    value = value / unit
    if value == 0:
        return "0"
    if 1e-2 <= abs(value) < 1e7:
        digits = f"{value:.3g}"
        return f"{float(digits):,.0f}" if abs(value) >= 100 else digits
    return f"{value:.1e}"


def rows(header: list[str], lines: list[list[str]]) -> list[str]:
    """A Markdown table; columns after the first are right-aligned."""
    out = ["| " + " | ".join(header) + " |", "|---" + "|---:" * (len(header) - 1) + "|"]
    return [*out, *("| " + " | ".join(line) + " |" for line in lines), ""]


def source(report: dict) -> str:
    """The date and the commit of a result, or of a part of one (its ``origin``)."""
    date = report.get("date", "")
    if head := report.get("commit"):
        name, _, changed = head.partition("-")
        return f"{date}, commit `{name[:7]}`{' with uncommitted changes' if changed else ''}"
    if head := report.get("committed_with"):
        return f"{date}, committed with `{head[:7]}`"
    return f"{date}, commit unknown"


def command(report: dict) -> str:
    """The command of a result, its date and its commit."""
    return f"`{report['command']}`, {source(report)}"


def machine(report: dict) -> str:
    """One line on where and how a result was made."""
    about = report["machine"]
    names = {k: v for k, v in report["versions"].items() if v and k != "equinox"}
    flags = f", `XLA_FLAGS={report['flags']}`" if report["flags"] else ""
    threads = report.get("threads")
    model = f" ({about['model']})" if about.get("model") else ""
    return (
        f"`{report['command']}` on {about['processor']}{model}, {about['system']},"
        f" {about.get('memory_GB', '?')} GB, {threads} core{'s' if threads != 1 else ''} of a"
        f" shared virtual machine{flags}; "
        + ", ".join(f"{name} {version}" for name, version in names.items())
        + f"; {source(report)}."
    )
