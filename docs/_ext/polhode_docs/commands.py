"""The page of the command line, docs/cli.md, written from the commands themselves.

python docs/_ext/polhode_docs/commands.py > docs/cli.md
"""

import inspect

import typer

from polhode.cli._main import app

INTRODUCTION = """# Command line

From a checkout: `pip install '.[cli]'`; ensembles need `.[cli,scale]`, runs on a dask cluster
`.[cli,dask]`. `python -m polhode` is the same as `polhode`. Every command has `--help`.
Progress is shown on a terminal only; `--quiet` prints errors only.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | the computation or the writing failed |
| 2 | wrong options, or a wrong input file |
| 130 | interrupted (Ctrl-C) |
| 143 | terminated |
"""


def cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def rows(command) -> list[str]:
    """The arguments and options of a command, a row of a table each."""
    found = []
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            name = (parameter.metavar or parameter.name.upper()).strip("[]")
        else:
            names = ", ".join(parameter.opts)
            flag = getattr(parameter, "is_flag", False)
            kind = parameter.metavar or "VALUE"
            name = names + ("" if flag else f" {kind}")
        words = getattr(parameter, "help", None) or ""
        default = parameter.default
        if default not in (None, False, "", (), []) and getattr(parameter, "show_default", False):
            shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
            words += f" (default: {shown})"
        found.append(f"| `{cell(name)}` | {cell(words)} |")
    return found


def page() -> str:
    """The page as Markdown."""
    group = typer.main.get_command(app)
    parts = [INTRODUCTION]
    for name, command in group.commands.items():
        parts.append(f"## `polhode {name}`\n\n{inspect.cleandoc(command.help)}\n")
        parts.append("| argument or option | |\n|---|---|\n" + "\n".join(rows(command)) + "\n")
        if command.epilog:
            parts.append(f"{command.epilog.replace('example: ', 'Example: `')}`\n")
    return "\n".join(parts)


if __name__ == "__main__":
    print(page(), end="")
