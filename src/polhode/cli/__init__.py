"""The command line: `polhode run`, `explain`, `fit`, `view`, `lightcurve`, `scenes`, `schema`."""

import contextlib
import os
import sys
from collections.abc import Sequence

from polhode._extras import how_to_install


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    0: success; 1: the computation or the output failed; 2: wrong usage or input, such as a file
    that is missing, malformed or of another kind; 130: interrupted (Ctrl-C).

    Raises SystemExit for --help, wrong options and termination (143).
    """
    # jaxlib 0.10.0 logs false errors about missing CPU features when it loads programs from its
    # cache. The level must be set before JAX is imported. Real errors are raised as exceptions.
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
    """The `polhode` command: runs `main` and ends the process with its exit code.

    After an interrupt or termination it ends by ``os._exit``: otherwise the threads of an ensemble
    would first complete their chunks; and if an interrupt, though caught, occurred in code compiled
    from a string, as in the import of a data class, ``python -m`` would end by the signal and not
    with the exit code.
    """
    try:
        code = main()
    except KeyboardInterrupt:  # before the command line was parsed
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
