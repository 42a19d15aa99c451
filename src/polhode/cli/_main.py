"""The `polhode` command: its subcommands, exit codes and error messages.

JAX is not imported before a command runs, so that `--help` and error messages appear quickly.
"""

import difflib
import functools
import gc
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from polhode.cli import _commands, _fit, _run
from polhode.cli._options import READERS, UsageError, reset_outputs, state_of_outputs
from polhode.cli._process import INTERRUPTED, TERMINATED, signal_handlers
from polhode.files import SceneFileError
from polhode.files._read import escape

SUCCESS, FAILURE, USAGE = 0, 1, 2
_codes: list[int] = []
_arguments: list[str] = []


def arguments() -> list[str]:
    """The arguments of the current command."""
    return list(_arguments)


_SYNONYMS = {
    "run": ("simulate", "sim", "solve", "integrate", "propagate", "start", "exec", "execute"),
    "explain": ("plan", "describe", "check", "validate", "info", "inspect"),
    "fit": ("identify", "inertia", "estimate", "calibrate"),
    "lightcurve": ("light-curve", "light_curve", "lc", "photometry"),
    "view": ("plot", "show", "page", "html", "animate", "viewer", "display", "draw", "open"),
    "schema": ("json-schema", "jsonschema", "json_schema"),
    "scenes": ("scene", "examples", "example", "list", "ls", "demo"),
    "reference": ("truth", "tumbling", "exact", "reference_motions"),
    "--help": ("help",),
    "--version": ("version",),
}


class _Commands(typer.core.TyperGroup):
    """The commands; the error for an unknown one suggests a similar command."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = args[0]
        if self.get_command(ctx, name) is None and not name.startswith("-"):
            ctx.fail(f"No such command {escape(name)!r}.{_hint(name)}")
        return super().resolve_command(ctx, args)


def _hint(name: str) -> str:
    """A hint for an unknown command: the command that reads such a file, a synonym, or a command
    with a similar name."""
    if reader := READERS.get(Path(name).suffix):
        return f" It is the name of a file: {reader}."
    for command, others in _SYNONYMS.items():
        if name.lower() in (command, *others):
            return f" Did you mean {command!r}?"
    close = difflib.get_close_matches(name.lower(), _SYNONYMS, 1)
    return f" Did you mean {close[0]!r}?" if close else f" There are {', '.join(_COMMANDS)}."


app = typer.Typer(
    name="polhode",
    cls=_Commands,
    help="Simulate, fit and visualise rotating rigid bodies.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong options or input file, 130 interrupted.",
    add_completion=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(show: bool) -> bool:
    if show:
        from polhode import __version__

        print(f"polhode {__version__}")
        raise typer.Exit
    return show


@app.callback()
def _top(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_version, help="show the version")
    ] = False,
) -> None:
    """Rotating rigid bodies: simulate scenes written as TOML files, fit inertia."""


def _guarded(command: Callable[..., int]) -> Callable[..., None]:
    """The command with all errors printed as messages; its exit code is stored for `main`."""

    @functools.wraps(command)
    def guarded(*arguments: Any, **options: Any) -> None:
        call = functools.partial(command, *arguments, **options)
        _codes.append(_run_guarded(call, options.get("debug", False)))

    return guarded


# Thresholds of garbage collection. Tracing a fit creates millions of long-lived objects. With
# Python's default thresholds their repeated scanning takes a sixth of the time of a command with
# cached programs.
_GC_THRESHOLDS = (200_000, 50, 100)


def _run_guarded(command: Callable[[], int], debug: bool) -> int:
    reset_outputs()
    thresholds = gc.get_threshold()
    gc.set_threshold(*_GC_THRESHOLDS)
    try:
        with signal_handlers(), warnings.catch_warnings():
            # ``status`` reports overflows, and missing glyphs in figures are visible as boxes:
            # both warnings are ignored. Others are printed without their source location.
            warnings.simplefilter("ignore", RuntimeWarning)
            warnings.filterwarnings("ignore", "Glyph", UserWarning)
            warnings.showwarning = _print_warning
            code = command()
            sys.stdout.flush()
            return code
    except KeyboardInterrupt:
        print(f"\npolhode: interrupted; {state_of_outputs()}", file=sys.stderr)
        return INTERRUPTED
    except SystemExit as ended:
        if ended.code == TERMINATED:
            print(f"\npolhode: terminated; {state_of_outputs()}", file=sys.stderr)
        raise
    except BrokenPipeError:  # the reader of the output has closed the pipe
        _silence(sys.stdout)
        return FAILURE
    except Exception as error:
        return _report(error, debug)
    finally:
        gc.set_threshold(*thresholds)


def _print_warning(message: Warning | str, *_: Any) -> None:
    print(f"polhode: {escape(str(message))}", file=sys.stderr)


def _report(error: Exception, debug: bool) -> int:
    """Print the error to stderr and return its exit code."""
    if debug:
        traceback.print_exception(error)
    bad_input = isinstance(error, SceneFileError | UsageError)
    text = str(error) or type(error).__name__
    if isinstance(error, MemoryError):
        text = f"not enough memory ({text}): use fewer bodies or times, or use an [ensemble]"
    expected = bad_input or isinstance(error, OSError | ImportError | RuntimeError | MemoryError)
    lead = "" if expected else f"{type(error).__name__}: "
    hint = "" if expected or debug else "\n  (run again with --debug to see where)"
    if isinstance(error, OSError) and error.strerror:  # without the errno that str() begins with
        text = ": ".join(str(part) for part in (error.filename, error.strerror) if part)
    block = "\n".join(map(escape, f"{lead}{text}{hint}".split("\n")))
    print(f"polhode: {block}", file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:  # output redirected to a full disk: discard the rest
        _silence(sys.stdout)
    return USAGE if bad_input else FAILURE


def _silence(stream: Any) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


_COMMANDS = {
    "run": _run.run,
    "explain": _commands.explain,
    "fit": _fit.fit,
    "schema": _commands.schema,
    "view": _commands.view,
    "lightcurve": _commands.lightcurve,
    "scenes": _commands.scenes,
    "reference": _commands.reference,
}
_EXAMPLES = {
    "run": "example: polhode run toutatis -o toutatis.nc",
    "fit": "example: polhode fit toss.csv --columns t=time wx=gx wy=gy wz=gz -o toss",
}
for _name, _command in _COMMANDS.items():
    app.command(_name, epilog=_EXAMPLES.get(_name))(_guarded(_command))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; see `polhode.cli.main`."""
    _codes.clear()
    _arguments[:] = map(str, sys.argv[1:] if argv is None else argv)
    try:
        typer.main.get_command(app).main(args=list(_arguments), prog_name="polhode")
    except SystemExit:
        if not _codes:
            raise
    return _codes[-1]
