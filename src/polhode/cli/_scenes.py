"""`polhode scenes`: the scenes that come with polhode."""

import difflib
import os
from typing import Annotated

import typer

from polhode.cli import _targets
from polhode.cli._options import DebugOption, ForceOption
from polhode.cli._targets import UsageError


def scenes(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="the scene to copy", show_default=False)
    ] = None,
    output: Annotated[
        str | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            show_default=False,
            help="where to copy it (default: NAME.toml here)",
        ),
    ] = None,
    force: ForceOption = False,
    debug: DebugOption = False,
) -> int:
    """List the scenes that come with polhode, which `polhode run NAME` runs; or copy one."""
    import tomllib

    from polhode.files import shipped_scenes
    from polhode.files._atomic import whole_file
    from polhode.files._error import visible

    shipped = shipped_scenes()
    if name is None:
        if output is not None:
            raise UsageError("-o needs the NAME of the scene to copy.")
        for key, path in shipped.items():
            title = tomllib.loads(path.read_text(encoding="utf-8")).get("title", "")
            print(f"{key:<16}{visible(title)}")
        print("\npolhode run NAME runs a scene, polhode scenes NAME copies it into this folder")
        return 0
    if name not in shipped:
        close = difflib.get_close_matches(name.removesuffix(".toml"), shipped, 1)
        hint = f"; did you mean {close[0]}?" if close else "."
        raise UsageError(f"there is no scene {name!r}: there are {', '.join(shipped)}{hint}")
    _targets.check_suffix(output or "", ".toml", what="a scene file")
    goal = _targets.target(output or name, ".toml", force=True)
    if os.path.lexists(goal) and not force:  # a copy that was edited names polhode too
        raise FileExistsError(
            f"{goal} exists: name another file with -o, or give --force to replace it"
        )
    with whole_file(goal) as temporary:
        temporary.write_bytes(shipped[name].read_bytes())
    print(f"written: {visible(str(goal))}")
    return 0
