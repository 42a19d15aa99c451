"""The command line: `polhode run`, `polhode explain`."""

from polhode.cli._main import main as main
