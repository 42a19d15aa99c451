"""The command line: `polhode run`, `explain`, `fit`, `view`, `lightcurve`, `scenes`, `schema`."""

import contextlib
import os
import sys
from collections.abc import Sequence

from polhode._extras import how_to_install


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    0: done; 1: the computation or the writing failed; 2: wrong usage or wrong input, such as a file
    that is missing, malformed or of another kind; 130: interrupted (Ctrl-C).

    Raises SystemExit for --help, wrong options and termination (143).
    """
    # Of programs in its cache, jaxlib 0.10.0 reports flags of its own as features that the machine
    # lacks, as errors. To be set before JAX is imported; what fails is raised as an exception.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        from polhode.cli._main import main as command_line
    except ModuleNotFoundError as error:
        words = sys.argv[1:] if argv is None else argv
        command = " ".join(["polhode", *map(str, words[:1])])
        print(f"polhode: `{command}` needs {error.name}: {how_to_install('cli')}", file=sys.stderr)
        return 1
    return command_line(argv)


def command() -> None:
    """The `polhode` command: `main`, which ends the process.

    After an interrupt or termination at once: the threads of an ensemble would first complete
    their chunks, and where the interrupt met code made from text, as imports of data classes do,
    ``python -m`` would end by the signal and not with the exit code, though it was caught.
    """
    try:
        code = main()
    except KeyboardInterrupt:  # before the command line was read
        code = 130
    except SystemExit as ended:
        if ended.code != 143:
            raise
        code = 143
    if code in (130, 143):
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
    sys.exit(code)
