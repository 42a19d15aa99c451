"""The `polhode` command: options, exit codes and errors in one readable block.

Every command is a module of this room with `register(commands)`; nothing heavy is imported before
a command runs, so that `--help` and mistakes in the options answer at once.
"""

import argparse
import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence

from polhode.cli import _explain, _fit, _run

SUCCESS, FAILURE, USAGE, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143
_COMMANDS = (_run, _explain, _fit)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    0: done; 1: the simulation or the writing failed; 2: wrong options or a bad scene file; 130:
    interrupted (Ctrl-C); 143: terminated. Raises SystemExit for --help and wrong options, as
    argparse does.
    """
    arguments = _parser().parse_args(argv)
    try:
        with _terminable():
            return arguments.command(arguments)
    except KeyboardInterrupt:
        print("\npolhode: interrupted; no file was changed", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output went away: nobody to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE
    except Exception as error:
        return _report(error, arguments.debug)


def _parser() -> argparse.ArgumentParser:
    from polhode import __version__

    parser = argparse.ArgumentParser(
        prog="polhode",
        description="Rotating rigid bodies: simulate scenes written as TOML files, fit inertia.",
        epilog="Exit codes: 0 done, 1 failed, 2 wrong options or input file, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"polhode {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in _COMMANDS:
        command = module.register(commands)
        command.add_argument(
            "--debug", action="store_true", help="show the full traceback of an error"
        )
    return parser


def _report(error: Exception, debug: bool) -> int:
    """Print the error to stderr; the exit code that belongs to it."""
    from polhode.io import SceneFileError

    if debug:
        traceback.print_exception(error)
    bad_input = isinstance(error, SceneFileError)
    text = str(error) or type(error).__name__
    known = bad_input or isinstance(error, OSError | ImportError | RuntimeError | MemoryError)
    lead = "" if known else f"{type(error).__name__}: "
    hint = "" if known or debug else "\n  (run again with --debug to see where)"
    print(f"polhode: {lead}{text}{hint}", file=sys.stderr)
    return USAGE if bad_input else FAILURE


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM unwind like an exception, so that temporary files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_):
        raise SystemExit(TERMINATED)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
