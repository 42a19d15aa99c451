"""`polhode explain SCENE`: what would run, what is skipped, and why."""

import argparse

from polhode.cli._options import add_scene, read


def register(commands) -> argparse.ArgumentParser:
    """Add the command to the parser."""
    command = commands.add_parser(
        "explain",
        help="say how a scene would be computed, without computing it",
        description="Read and check a scene file and say which method would run, and why.",
    )
    add_scene(command)
    command.set_defaults(command=explain)
    return command


def explain(arguments: argparse.Namespace) -> int:
    """Print the scene in short and the plan."""
    import polhode
    from polhode.cli._job import prepare
    from polhode.io import blamed

    file = read(arguments)
    job = prepare(file, arguments.precision)
    with blamed(file, ""):
        plan = polhode.explain(job.scene, job.state, job.ts, job.method, rtol=job.rtol)
    times, carlo = file.times, file.monte_carlo
    span = (
        f"{times.seconds[0] / times.unit_seconds:g} to {times.seconds[-1] / times.unit_seconds:g}"
    )
    print(f"{file.title}\n  source: {file.source or 'not stated'}")
    print(f"  {len(times.seconds)} samples from {span} {times.unit}, {arguments.precision}")
    if carlo is not None:
        print(f"  {carlo.clones} clones, seed {carlo.seed}, drawn from the spread of:")
        for spread in carlo.spreads:
            print(f"    {spread.quantity}: {spread.source}")
    print()
    print(plan)
    return 0
