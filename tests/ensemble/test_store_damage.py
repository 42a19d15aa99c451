"""Stores with missing or altered files: completed to the same bits, or rejected."""

import json
import os
import shutil

import numpy as np
import pytest

from polhode import ensemble as ens

zarr = pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from ensemble_case import CHUNK, TS, make

from polhode.ensemble._statistics import tilt

BODIES = 2 * CHUNK + 100
TILT = ens.Statistic("tilt", tilt, "rad", 0.0, 3.2, 64)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "whole.zarr"
    return again(path)


def again(path, **options):
    given = {"chunk": CHUNK, "statistics": [TILT], "attributes": {"title": "t"}} | options
    return ens.stream(make(BODIES), TS, path, **given)


def _flip(file, at=0.5):
    data = bytearray(file.read_bytes())
    data[int(at * (len(data) - 1))] ^= 4
    file.write_bytes(data)


def _cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _altered(path, name, **entries):
    file = path / name / "zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | entries))


def _settings(path, change):
    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    group.attrs["polhode"] = change(group.attrs["polhode"])


def _left(path):
    """An incomplete file from an earlier run."""
    path.write_text("x")
    os.utime(path, (0, 0))


COMPLETED = {
    "flip": lambda p: _flip(p / "wxyz" / "c" / "1" / "0" / "0"),
    "flip at the beginning": lambda p: _flip(p / "wxyz" / "c" / "0" / "0" / "0", 0.0),
    "flip of the checksum": lambda p: _flip(p / "status" / "c" / "1", 1.0),
    "flip in the last chunk": lambda p: _flip(p / "omega_body" / "c" / "2" / "0" / "0"),
    "flip of a statistic": lambda p: _flip(p / "tilt_mean" / "c" / "2" / "0"),
    "flip of a summary": lambda p: _flip(p / "tilt_summary_mean" / "c" / "0"),
    "truncation": lambda p: _cut(p / "omega_body" / "c" / "2" / "0" / "0"),
    "empty file": lambda p: (p / "tilt_histogram" / "c" / "0" / "0" / "0").write_bytes(b""),
    "lost chunk": lambda p: (p / "status" / "c" / "1").unlink(),
    "all chunks of an array lost": lambda p: shutil.rmtree(p / "wxyz" / "c"),
    "lost times": lambda p: shutil.rmtree(p / "time" / "c"),
    "flip of the times": lambda p: _flip(p / "time" / "c" / "0"),
    "altered times": lambda p: zarr.open_array(p / "time", mode="r+").__setitem__(1, 9.0),
    "lost summary": lambda p: shutil.rmtree(p / "tilt_summary_mean"),
    "partial file": lambda p: _left(p / "wxyz" / "c" / "0" / "0" / "0.ab12.partial"),
    "foreign metadata of a summary": lambda p: (p / "tilt_summary_std" / "zarr.json").write_text(
        "[]"
    ),
    "foreign file": lambda p: (p / "wxyz" / "c" / "1" / "0" / "0").write_text("foreign"),
}
REFUSED = {
    "lost array": (lambda p: shutil.rmtree(p / "wxyz"), "wxyz/zarr.json"),
    "lost metadata": (lambda p: (p / "zarr.json").unlink(), "zarr.json"),
    "another shape": (lambda p: _altered(p, "omega_body", shape=[7, 3, 3]), "shape"),
    "another type": (lambda p: _altered(p, "omega_body", data_type="float32"), "data_type"),
    "another fill value": (lambda p: _altered(p, "wxyz", fill_value=1.0), "fill_value"),
    "other codecs": (lambda p: _altered(p, "status", codecs=[]), "codecs"),
    "other attributes": (lambda p: _altered(p, "wxyz", attributes={"units": "m"}), "attributes"),
    "metadata that are no JSON": (
        lambda p: (p / "status" / "zarr.json").write_text("[1, 2"),
        "status/zarr.json",
    ),
    "metadata that are a list": (
        lambda p: (p / "status" / "zarr.json").write_text("[1, 2]"),
        "status/zarr.json",
    ),
    "another title": (lambda p: zarr.open_group(p, mode="r+").attrs.update(title="u"), "title"),
    "no consolidated metadata": (
        lambda p: (p / "zarr.json").write_text(
            json.dumps(json.loads((p / "zarr.json").read_text()) | {"consolidated_metadata": None})
        ),
        "consolidated",
    ),
    "a file in the place of an array": (
        lambda p: (shutil.rmtree(p / "wxyz"), (p / "wxyz").write_text("x")),
        "wxyz/zarr.json",
    ),
}


@pytest.mark.parametrize("kind", COMPLETED)
def test_what_was_lost_is_computed_again(whole, tmp_path, kind):
    path = tmp_path / "hurt.zarr"
    shutil.copytree(whole, path)
    COMPLETED[kind](path)
    again(path)
    with ens.open_store(path) as ours, ens.open_store(whole) as theirs:
        xarray.testing.assert_identical(ours.load(), theirs.load())
    assert not list(path.rglob("*.partial"))


@pytest.mark.parametrize("kind", REFUSED)
def test_altered_metadata_are_refused(whole, tmp_path, kind):
    path = tmp_path / "hurt.zarr"
    shutil.copytree(whole, path)
    damage, words = REFUSED[kind]
    damage(path)
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    with pytest.raises(ens.StoreError, match="was left as it is") as caught:
        again(path)
    assert words in str(caught.value)
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize(
    "change",
    [
        lambda text: json.dumps(json.loads(text) | {"chunk": 0}),
        lambda text: json.dumps(json.loads(text) | {"chunk": -CHUNK}),
        lambda text: json.dumps(json.loads(text) | {"chunk": 2 * CHUNK}),
        lambda text: json.dumps(json.loads(text) | {"chunk": True}),
        lambda text: json.dumps(json.loads(text) | {"chunk": "8192"}),
        lambda text: json.dumps(json.loads(text) | {"chunk": None}),
        lambda text: json.dumps(json.loads(text) | {"arrays": ["../x"]}),
        lambda text: json.dumps(json.loads(text) | {"seed": 8}),
        lambda text: json.dumps([text]),
        lambda text: "{",
        lambda text: 17,
        lambda text: {"bodies": 3},
        lambda text: None,
    ],
)
def test_settings_that_are_not_possible_are_refused(whole, tmp_path, change):
    path = tmp_path / "hurt.zarr"
    shutil.copytree(whole, path)
    _settings(path, change)
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    with pytest.raises(ens.StoreError, match="was left as it is"):
        again(path)
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


def test_chunks_that_equal_the_fill_value_are_written(tmp_path):
    """By default Zarr omits such chunks; a lost chunk would then read as one of them."""
    import jax.numpy as jnp

    import polhode as ph

    def failing(key, scene, state):
        return scene, ph.State(state.wxyz, jnp.nan * state.omega_body)

    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]))
    ensemble = ens.Ensemble(scene, ph.State([1.0, 0, 0, 0], [0.0, 1.0, 0.0]), 20, (failing,))
    path = ens.stream(ensemble, TS, tmp_path / "nan.zarr", name="NaN")
    with ens.open_store(path) as data:
        assert np.isnan(data.omega_body).all()
        assert ((data.status > 0) & (data.status < 255)).all()
    (path / "status" / "c" / "0").unlink()
    with pytest.raises(ens.StoreError, match="1 of 1 chunks is missing"):
        ens.open_store(path)
    with xarray.open_zarr(path) as data:
        assert (data.status == 255).all()


def test_codecs_and_devices(whole):
    status = json.loads((whole / "status" / "zarr.json").read_text())
    assert [codec["name"] for codec in status["codecs"]] == ["bytes", "zstd", "crc32c"]
    assert status["fill_value"] == 255
    with ens.open_store(whole) as data:
        assert data.attrs["devices"] == "1 x cpu (cpu)"
        assert np.array_equal(data.time, TS)
