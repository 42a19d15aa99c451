"""Careless or hostile input: every case ends with one message and the right exit code."""

import contextlib
import datetime
import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray

import polhode as ph
from polhode.cli import _process, main
from polhode.files import _write

FREE = """title = "free"
[inertia]
axisymmetric = { transverse = 1.0, axial = 1.5 }
[state]
omega_body = [0.5, 0.2, 3.0]
[times]
stop = 2.0
number = 5
"""
BATCH = """[inertia]
moments = [1.0, 1.5, 2.0]
[state]
omega_body = [0.5, 0.2, 3.0]
[times]
stop = 2.0
number = 5
[ensemble]
bodies = 20
seed = 1
[ensemble.arrays]
moments = "m.npy"
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty current folder that contains the small scene."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "free.toml").write_text(FREE)
    return tmp_path


def refused(capsys, arguments, code, *hints):
    """Run a command that must end with this exit code and one message that contains the hints."""
    assert main([str(a) for a in arguments]) == code
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("polhode: ")
    assert "Traceback" not in told.err
    assert told.err.replace("\n", "").isprintable()
    for hint in hints:
        assert hint in told.err


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a disk of 40 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=40k", "tmpfs", str(folder)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("only root can make a small disk")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_told_and_nothing_is_half_written(here, capsys, small_disk):
    (here / "long.toml").write_text(FREE.replace("number = 5", "number = 2000"))
    refused(
        capsys,
        ["run", "long.toml", "-o", small_disk / "out.nc", "--no-figure"],
        1,
        "No space left",
        "out.nc",
        str(small_disk),
    )
    assert list(small_disk.iterdir()) == []


def test_a_disk_that_fills_up_meanwhile(here, capsys, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(_write.os, "fsync", full)
    refused(
        capsys,
        ["run", "free.toml", "-o", "out.nc", "--no-figure"],
        1,
        "No space",
        "out.nc",
        str(here),
    )
    assert [path.name for path in here.iterdir()] == ["free.toml"]


@pytest.mark.parametrize("command", [["schema"], ["explain", "free.toml"]])
def test_output_to_a_full_device_is_an_error(here, command):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    code = "import sys; from polhode.cli import main; sys.exit(main(sys.argv[1:]))"
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code, *command],
            stdout=full,
            text=True,
            stderr=subprocess.PIPE,
            timeout=300,
        )
    assert done.returncode == 1
    assert "No space left" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("output", "code", "hints"),
    [
        (".", 1, ["is a folder"]),
        ("..", 1, ["is a folder"]),
        ("/", 1, ["is a folder"]),
        ("a\0b", 2, ["a\\x00b", "NUL"]),
        ("mine.nc", 1, ["mine.nc", "--force"]),
        ("link.nc", 1, ["link.nc", "is a link", "--force"]),
        ("pipe.nc", 1, ["pipe.nc", "--force"]),
        ("mine.nc/x", 1, ["x.nc", "mine.nc"]),
        ("x" * 300, 1, ["too long"]),
    ],
)
def test_targets_that_cannot_or_must_not_be_written(here, capsys, output, code, hints):
    (here / "mine.nc").write_text("a letter")
    (here / "link.nc").symlink_to("mine.nc")
    os.mkfifo(here / "pipe.nc")
    refused(capsys, ["run", "free.toml", "-o", output, "--no-figure"], code, *hints)
    assert (here / "mine.nc").read_text() == "a letter"
    assert (here / "link.nc").is_symlink()


def test_only_files_of_polhode_are_replaced_unasked(here, capsys):
    (here / "free.png").write_text("a picture of the user's, made from results of polhode")
    refused(capsys, ["run", "free.toml"], 1, "free.png", "--force")
    assert not (here / "free.nc").exists()
    assert main(["run", "free.toml", "-q", "--force"]) == 0
    assert main(["run", "free.toml", "-q"]) == 0  # now polhode has written both files


@pytest.mark.parametrize(
    ("name", "hints"),
    [
        ("/etc/x.nc", ["[output] file", "leaves the folder"]),
        ("../x.nc", ["[output] file", "leaves the folder"]),
        ("a/../../x.nc", ["[output] file"]),
        ("C:/x.nc", ["[output] file"]),
        ("a\\u0000b", ["[output] file"]),
        ("a\\u001b[31mb", ["[output] file"]),
        ("way/x.nc", ["[output] file", "by a link"]),
    ],
)
def test_a_scene_names_no_file_outside_its_folder(here, capsys, tmp_path_factory, name, hints):
    away = tmp_path_factory.mktemp("away")
    (here / "way").symlink_to(away)
    (here / "out.toml").write_text(FREE + f'[output]\nfile = "{name}"\n')
    refused(capsys, ["run", "out.toml", "--no-figure"], 2, *hints)
    assert list(away.iterdir()) == []


def _pipe(path):
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("make", "hint"),
    [
        (_pipe, "not a regular file"),
        (lambda p: p.mkdir(), "not a regular file"),
        (lambda p: p.write_bytes(b""), "cannot be read"),
        (lambda p: p.write_bytes(b"\x93NUMPY\x01\x00\xff\xff" + b"{" * 40), "cannot be read"),
        (lambda p: p.write_bytes(b"\x93NUMPY\x01\x00\x46\x00" + b"(" * 69 + b"\n"), "cannot be"),
        (lambda p: p.write_bytes(b"\x93NUMPY\x07\x00\x46\x00" + b" " * 70), "cannot be read"),
        (lambda p: p.write_bytes(_header("'<f8'", "(20, -3)")), ""),
        (lambda p: p.write_bytes(_header("'<f8'", "(20, 3)")), "cannot be read"),
        (lambda p: p.write_bytes(_header("'|O'", "(20, 3)") + bytes(480)), "cannot be read"),
        (lambda p: p.write_bytes(_header("'<f8'", "(99999999999, 3)")), "cannot be read"),
        (lambda p: p.symlink_to("/dev/zero"), "leaves the folder"),
        (lambda p: np.save(p, np.full((20, 3), np.nan)), "row 0"),
        (lambda p: np.save(p, np.ones((20, 3), "datetime64[s]")), "wrong shape or type"),
    ],
)
def test_arrays_that_are_none(here, capsys, make, hint):
    (here / "batch.toml").write_text(BATCH)
    make(here / "m.npy")
    refused(capsys, ["run", "batch.toml"], 2, "[ensemble.arrays] moments", hint)


def _header(kind, shape):
    text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def test_text_from_files_does_not_command_the_terminal(here, capsys):
    text = FREE.replace('"free"', '"cost $5 and $x_$ \\u001b[31m\\u0007\\u202e"')
    (here / "odd\x1b[2J.toml").write_text(text + 'source = "\\u001b]0;x"\n' * 0)
    assert main(["run", "odd\x1b[2J.toml", "-o", "odd.nc"]) == 0
    told = capsys.readouterr()
    for stream in (told.out, told.err):
        assert "\x1b" not in stream
        assert "\u202e" not in stream
    assert "cost $5 and $x_$ \\x1b[31m" in told.out
    (here / "odd\x1b[2J.toml").write_text(FREE.replace("axial", '"axi\\u001b[31m"'))
    refused(capsys, ["run", "odd\x1b[2J.toml"], 2, "odd\\x1b[2J.toml", "\\x1b[31m")
    refused(capsys, ["run", "gone\udc80.toml"], 2, "gone\\udc80")


def test_provenance_is_what_ran(here, capsys):
    scene = here / "top.toml"
    text = FREE + '[monte_carlo]\nclones = 9\nseed = 5\nattitude = { sigma = 0.1, source = "t" }\n'
    scene.write_text(text)

    def seen():
        with xarray.open_dataset("out.nc", engine="h5netcdf") as data:
            return dict(data.attrs), dict(data["status"].attrs), data["status"].dtype, data.wxyz

    command = ["--clones", "3", "--seed", "7", "--precision", "float32", "--no-figure", "-q"]
    main(["run", "top.toml", "-o", "out.nc", *command])
    found, flags, kind, _ = seen()
    import jaxlib

    assert (found["seed"], found["clones"], found["precision"]) == (7, 3, "float32")
    assert json.loads(found["options"]).items() >= {"seed": 7, "clones": 3}.items()
    assert found["scene"] == text
    assert found["Conventions"] == "CF-1.11"
    versions = [found[f"{name}_version"] for name in ("polhode", "jaxlib", "numpy")]
    assert versions == [ph.__version__, jaxlib.__version__, np.__version__]
    assert found["history"].endswith(f" polhode run top.toml -o out.nc {' '.join(command)}")
    assert datetime.datetime.fromisoformat(found["history"].split()[0]).tzinfo is not None
    assert found["method"].startswith("ClosedForm")
    commit = _write.commit()
    assert found.get("polhode_commit", "") == commit
    assert re.fullmatch(r"([0-9a-f]{40}(\+changes)?)?", commit)
    assert kind == np.int8
    assert flags["flag_meanings"].split()[0] == "successful"
    assert flags["flag_values"].dtype == np.int8


def test_standard_input_is_recorded_and_a_changed_file_is_not(here, monkeypatch):
    from polhode.cli import _job

    run = _job.run

    def meanwhile(*given):
        (here / "free.toml").write_text("something else")
        return run(*given)

    monkeypatch.setattr(_job, "run", meanwhile)
    assert main(["run", "free.toml", "-q", "--no-figure"]) == 0
    with xarray.open_dataset("free.nc", engine="h5netcdf") as data:
        assert data.attrs["scene"] == FREE
    with open(here / "pipe", "w") as file:
        file.write(FREE)
    with open(here / "pipe") as file:
        before = os.dup(0)
        os.dup2(file.fileno(), 0)
        try:
            assert main(["run", "-", "-q", "--no-figure"]) == 0
        finally:
            os.dup2(before, 0)
    with xarray.open_dataset("stdin.nc", engine="h5netcdf") as data:
        assert data.attrs["scene"] == FREE


def test_relative_moments_have_units_that_fit_each_other(here):
    (here / "rel.toml").write_text(
        FREE.replace("[state]", 'unit = "relative"\n[state]').replace("number = 5", "number = 500")
    )
    assert main(["run", "rel.toml", "-q", "--no-figure"]) == 0
    with xarray.open_dataset("rel.nc", engine="h5netcdf") as data:
        units = {name: data[name].attrs["units"] for name in ("moments", "energy")}
        assert units == {"moments": "1", "energy": "s-2"}
        assert all("long_name" in data[name].attrs for name in (*data.data_vars, *data.coords))
        assert data["wxyz"].encoding["zlib"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_a_callback_swallowed_still_ends_the_run(here, capsys, monkeypatch, number):
    """JAX's callbacks print an exception and discard it."""
    simulate = ph.simulate

    def swallowing(*given, **options):
        with contextlib.suppress(BaseException):
            os.kill(os.getpid(), number)
            time.sleep(0.1)
        return simulate(*given, **options)

    monkeypatch.setattr(ph, "simulate", swallowing)
    monkeypatch.setattr(signal, "default_int_handler", signal.getsignal(signal.SIGINT))
    if number == signal.SIGINT:
        assert main(["run", "free.toml"]) == 130
    else:
        with pytest.raises(SystemExit) as caught:
            main(["run", "free.toml"])
        assert caught.value.code == 143
    assert "no file was changed" in capsys.readouterr().err
    assert [path.name for path in here.iterdir()] == ["free.toml"]


def test_an_interrupt_after_the_first_file_names_it(here, capsys, monkeypatch):
    from polhode.cli import _run

    def late(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(_run, "_draw", late)
    assert main(["run", "free.toml"]) == 130
    assert "written: free.nc; not written: free.png" in capsys.readouterr().err
    assert _process._received == []


def _modules(*arguments):
    """Exit code of a command in a new process, and the heavy modules that it imports."""
    code = (
        "import sys\n"
        "from polhode.cli import main\n"
        "try: code = main(sys.argv[1:])\n"
        "except SystemExit as ended: code = ended.code\n"
        "found = [m for m in ('jax', 'numpy', 'matplotlib', 'xarray') if m in sys.modules]\n"
        "print(code, found, sep='|', file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    return done.stderr.splitlines()[-1].split("|")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--help"], "0"),
        (["--version"], "0"),
        (["run", "bad.toml"], "2"),
        (["schema"], "0"),
        (["fit", "--nosie", "1"], "2"),
    ],
)
def test_help_and_mistakes_come_without_jax(here, arguments, code):
    (here / "bad.toml").write_text(FREE.replace("axial", "axail"))
    assert _modules(*arguments) == [code, "[]"]


def test_programs_are_kept_between_runs_unless_told_otherwise(here, monkeypatch):
    import jax

    monkeypatch.setenv("POLHODE_CACHE", str(here / "kept"))
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        with _process.program_cache(True):
            folder = Path(jax.config.jax_compilation_cache_dir)
            assert folder.parent == here / "kept"
        assert jax.config.jax_compilation_cache_dir is None
        with _process.program_cache(False):
            assert jax.config.jax_compilation_cache_dir is None
        monkeypatch.setenv("POLHODE_CACHE", "off")
        with _process.program_cache(True):
            assert jax.config.jax_compilation_cache_dir is None
        (here / "file").write_text("no folder")
        monkeypatch.setenv("POLHODE_CACHE", str(here / "file"))
        with _process.program_cache(True):
            assert jax.config.jax_compilation_cache_dir is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.slow  # two processes without compiled programs
def test_a_damaged_cache_is_no_error(here):
    """In new processes, since compiled programs are shared within one."""
    environment = os.environ | {"POLHODE_CACHE": str(here / "kept")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, "-m", "polhode", "run", "free.toml", "--no-figure", "-q"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    kept = list((here / "kept").rglob("*-cache"))
    assert kept
    for k, file in enumerate(kept):
        file.write_bytes(b"nothing of the kind" * (k % 2))
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert all(file.stat().st_size > 100 for file in (here / "kept").rglob("*-cache"))


def test_more_than_the_machine_holds_is_refused_before_the_work(here, capsys):
    carlo = '[monte_carlo]\nclones = 1000000\nseed = 5\nattitude = { sigma = 1, source = "t" }\n'
    (here / "big.toml").write_text(FREE.replace("number = 5", "number = 9000000") + carlo)
    refused(capsys, ["run", "big.toml"], 1, "not enough memory", "[ensemble]")
