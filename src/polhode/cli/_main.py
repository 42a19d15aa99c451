"""The `polhode` command: its commands, exit codes and errors in one readable block.

Nothing heavy is imported before a command runs, so that `--help` and mistakes answer at once.
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

from polhode.cli import _explain, _fit, _look, _reference, _run, _scenes, _targets
from polhode.cli._inputs import READERS
from polhode.cli._signals import INTERRUPTED, TERMINATED, heeded
from polhode.files import SceneFileError
from polhode.files._error import visible

SUCCESS, FAILURE, USAGE = 0, 1, 2
_codes: list[int] = []
_words: list[str] = []


def words() -> list[str]:
    """The arguments of the command that runs."""
    return list(_words)


_OTHER_WORDS = {
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
    """The commands; an unknown one is answered with the command that was probably meant."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = args[0]
        if self.get_command(ctx, name) is None and not name.startswith("-"):
            ctx.fail(f"No such command {visible(name)!r}.{_meant(name)}")
        return super().resolve_command(ctx, args)


def _meant(name: str) -> str:
    """A hint for an unknown command: one of the same meaning, or of a similar name."""
    if reader := READERS.get(Path(name).suffix):
        return f" It is the name of a file: {reader}."
    for command, others in _OTHER_WORDS.items():
        if name.lower() in (command, *others):
            return f" Did you mean {command!r}?"
    close = difflib.get_close_matches(name.lower(), _OTHER_WORDS, 1)
    return f" Did you mean {close[0]!r}?" if close else f" There are {', '.join(_NAMES)}."


app = typer.Typer(
    name="polhode",
    cls=_Commands,
    help="Rotating rigid bodies: simulate scenes written as TOML files, fit inertia, look at them.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong options or input file, 130 interrupted.",
    add_completion=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> bool:
    if wanted:
        from polhode import __version__

        print(f"polhode {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _top(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_version, help="show the version")
    ] = False,
) -> None:
    """Rotating rigid bodies: simulate scenes written as TOML files, fit inertia."""


def _guarded(command: Callable[..., int]) -> Callable[..., None]:
    """The command with every error told in one block; its exit code is noted for `main`."""

    @functools.wraps(command)
    def guarded(*given: Any, **options: Any) -> None:
        _codes.append(_run_guarded(functools.partial(command, *given, **options),
                                   options.get("debug", False)))  # fmt: skip

    return guarded


_COLLECTED = (200_000, 50, 100)
"""Thresholds of garbage collection: to trace a fit makes millions of objects that live, and to look
them over again and again takes a sixth of the time of a command whose programs are kept."""


def _run_guarded(command: Callable[[], int], debug: bool) -> int:
    _targets.forget()
    before = gc.get_threshold()
    gc.set_threshold(*_COLLECTED)
    try:
        with heeded(), warnings.catch_warnings():
            # numbers that overflow are told by the status, and letters without a picture are drawn
            # as boxes; what else warns is told without its place in the source
            warnings.simplefilter("ignore", RuntimeWarning)
            warnings.filterwarnings("ignore", "Glyph", UserWarning)
            warnings.showwarning = _warned
            code = command()
            sys.stdout.flush()
            return code
    except KeyboardInterrupt:
        print(f"\npolhode: interrupted; {_state_of_files()}", file=sys.stderr)
        return INTERRUPTED
    except SystemExit as ended:
        if ended.code == TERMINATED:
            print(f"\npolhode: terminated; {_state_of_files()}", file=sys.stderr)
        raise
    except BrokenPipeError:  # the reader of our output went away: nobody to tell
        _silence(sys.stdout)
        return FAILURE
    except Exception as error:
        return _report(error, debug)
    finally:
        gc.set_threshold(*before)


def _warned(message: Warning | str, *_: Any) -> None:
    print(f"polhode: {visible(str(message))}", file=sys.stderr)


def _state_of_files() -> str:
    written, left = ([visible(str(path)) for path in paths] for paths in _targets.changed())
    if not written:
        return "no file was changed"
    told = f"written: {', '.join(written)}"
    return told + (f"; not written: {', '.join(left)}" if left else "")


def _report(error: Exception, debug: bool) -> int:
    """Print the error to stderr; the exit code that belongs to it."""
    if debug:
        traceback.print_exception(error)
    bad_input = isinstance(error, SceneFileError | _targets.UsageError)
    text = str(error) or type(error).__name__
    if isinstance(error, MemoryError):
        text = f"not enough memory ({text}): ask for fewer bodies or times, or use an [ensemble]"
    known = bad_input or isinstance(error, OSError | ImportError | RuntimeError | MemoryError)
    lead = "" if known else f"{type(error).__name__}: "
    hint = "" if known or debug else "\n  (run again with --debug to see where)"
    if isinstance(error, OSError) and error.strerror:  # str() begins with the number of the error
        text = ": ".join(str(part) for part in (error.filename, error.strerror) if part)
    block = "\n".join(map(visible, f"{lead}{text}{hint}".split("\n")))
    print(f"polhode: {block}", file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:  # a full disk behind a redirection: nothing more can go there
        _silence(sys.stdout)
    return USAGE if bad_input else FAILURE


def _silence(stream: Any) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


_NAMES: list[str] = []
_EXAMPLES = {
    "run": "example: polhode run toutatis -o toutatis.nc",
    "fit": "example: polhode fit toss.csv --columns t=time wx=gx wy=gy wz=gz -o toss",
}
for _name, _command in (("run", _run.run), ("explain", _explain.explain), ("fit", _fit.fit),
                        ("schema", _explain.schema), ("view", _look.view),
                        ("lightcurve", _look.lightcurve),
                        ("scenes", _scenes.scenes),
                        ("reference", _reference.reference)):  # fmt: skip
    _NAMES.append(_name)
    app.command(_name, epilog=_EXAMPLES.get(_name))(_guarded(_command))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; see `polhode.cli.main`."""
    _codes.clear()
    _words[:] = map(str, sys.argv[1:] if argv is None else argv)
    try:
        typer.main.get_command(app).main(args=list(_words), prog_name="polhode")
    except SystemExit:
        if not _codes:
            raise
    return _codes[-1]
