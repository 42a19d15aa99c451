"""`polhode explain SCENE` and `polhode schema`: what would run, and what a scene file may say."""

from polhode.cli._options import (
    ClonesOption,
    DebugOption,
    PrecisionOption,
    SceneName,
    SeedOption,
    read,
)


def explain(
    scene: SceneName,
    clones: ClonesOption = None,
    seed: SeedOption = None,
    precision: PrecisionOption = "float64",
    debug: DebugOption = False,
) -> int:
    """Say how a scene would be computed, and why, without computing it."""
    from polhode.files._error import visible

    file = read(scene, clones, seed)
    import polhode
    from polhode.cli._job import prepare
    from polhode.files._build import blamed

    job = prepare(file, precision)
    with blamed(file, ""):
        plan = polhode.explain(job.scene, job.state, job.ts, job.method, rtol=job.rtol)
    times, carlo = file.times, file.monte_carlo
    first, last = (times.seconds[k] / times.unit_seconds for k in (0, -1))
    print(f"{visible(file.title)}\n  source: {visible(file.source) or 'not stated'}")
    print(f"  {len(times.seconds)} samples from {first:g} to {last:g} {times.unit}, {precision}")
    if carlo is not None:
        print(f"  {carlo.clones} clones, seed {carlo.seed}, drawn from the spread of:")
        for quantity, spread in carlo.spreads.items():
            print(f"    {quantity}: {visible(spread.source)}")
    print(f"\n{plan}")
    return 0


def schema(debug: DebugOption = False) -> int:
    """Print the JSON Schema of scene files, for editors."""
    import json

    from polhode.files import SceneFile

    print(json.dumps(SceneFile.model_json_schema(), indent=1))
    return 0
