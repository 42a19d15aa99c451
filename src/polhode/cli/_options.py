"""Options that several commands share."""

import argparse


def whole_number(least: int):
    """An argparse type: a whole number not below `least`."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least} up")
        return value

    return convert


def add_scene(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "scene", metavar="SCENE", help="scene file (TOML), see docs/scene_files.md"
    )
    command.add_argument(
        "--clones", type=whole_number(0), metavar="N",
        help="number of Monte Carlo clones, instead of the scene's; 0: the nominal body only",
    )  # fmt: skip
    command.add_argument(
        "--seed",
        type=whole_number(0),
        metavar="N",
        help="seed of the clones, instead of the scene's",
    )
    command.add_argument(
        "--precision", choices=("float64", "float32"), default="float64",
        help="floating-point numbers to compute with (default: %(default)s)",
    )  # fmt: skip


def read(arguments: argparse.Namespace):
    """The scene file with the options put in place of its own entries."""
    import dataclasses

    from polhode.io import SceneFileError, read_scene

    file = read_scene(arguments.scene)
    given = {"clones": arguments.clones, "seed": arguments.seed}
    given = {name: value for name, value in given.items() if value is not None}
    if not given:
        return file
    if given.get("clones") == 0:
        return dataclasses.replace(file, monte_carlo=None)
    if file.monte_carlo is None:
        raise SceneFileError(
            file.path,
            "[monte_carlo]",
            "missing table",
            f"--{next(iter(given))} on the command line",
            "a scene that states its uncertainties",
            "add [monte_carlo], or drop the option",
        )
    return dataclasses.replace(file, monte_carlo=dataclasses.replace(file.monte_carlo, **given))
