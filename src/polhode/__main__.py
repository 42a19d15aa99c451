"""`python -m polhode`: the same as the `polhode` command."""

from polhode.cli import command

if __name__ == "__main__":
    command()
