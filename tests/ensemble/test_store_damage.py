"""Stores that lost something, or were edited: mended or refused, never declared finished."""

import json
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


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "whole.zarr"
    return ens.stream(make(2 * CHUNK), TS, path, chunk=CHUNK, attributes={"title": "t"})


def again(path, warn=lambda _: None, **options):
    reports = []
    ens.stream(make(2 * CHUNK), TS, path, chunk=CHUNK, progress=reports.append, warn=warn,
               attributes={"title": "t"}, **options)  # fmt: skip
    return reports[-1]


def _altered(path, name, **fields):
    file = path / name / "zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | fields))


def _settings(path, change):
    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    group.attrs["polhode"] = change(group.attrs["polhode"])


DAMAGE = {
    "a lost array": (lambda p: shutil.rmtree(p / "wxyz"), 0),
    "lost marks": (lambda p: shutil.rmtree(p / "checksum"), 0),
    "lost times": (lambda p: shutil.rmtree(p / "time"), 2 * CHUNK),
    "altered times": (lambda p: zarr.open_array(p / "time", mode="r+").__setitem__(1, 9.0),
                      2 * CHUNK),
    "times lost from the disk": (lambda p: shutil.rmtree(p / "time" / "c"), 2 * CHUNK),
    "another shape": (lambda p: _altered(p, "omega_body", shape=[7, 3, 3]), 0),
    "another type": (lambda p: _altered(p, "omega_body", data_type="float32"), 0),
    "another fill value": (lambda p: _altered(p, "wxyz", fill_value=1.0), 0),
    "an attribute of another kind": (
        lambda p: _altered(p, "wxyz", attributes={"rows_per_chunk": "many"}), 0),
    "metadata that are none": (lambda p: (p / "status" / "zarr.json").write_text("[1, 2"), 0),
    "the title": (lambda p: zarr.open_group(p, mode="r+").attrs.update(title=[1]), 2 * CHUNK),
    "a file in the place of an array": (
        lambda p: (shutil.rmtree(p / "wxyz"), (p / "wxyz").write_text("x")), 0),
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "verify"), [*((kind, True) for kind in DAMAGE), ("a lost array", False)]
)
def test_what_was_lost_is_made_anew(whole, tmp_path, kind, verify):
    path = tmp_path / "hurt.zarr"
    shutil.copytree(whole, path)
    damage, reused = DAMAGE[kind]
    damage(path)
    told = []
    report = again(path, told.append, verify=verify)
    assert (report.done, report.reused) == (2 * CHUNK, reused)
    assert bool(told) == (kind != "the title")
    with xarray.open_zarr(path) as ours, xarray.open_zarr(whole) as theirs:
        xarray.testing.assert_identical(ours.load(), theirs.load())


@pytest.mark.parametrize(
    "change",
    [
        lambda text: json.dumps(json.loads(text) | {"chunk": 0}),
        lambda text: json.dumps(json.loads(text) | {"chunk": -CHUNK}),
        lambda text: json.dumps(json.loads(text) | {"chunk": True}),
        lambda text: json.dumps(json.loads(text) | {"chunk": "8192"}),
        lambda text: json.dumps(json.loads(text) | {"chunk": None}),
        lambda text: json.dumps(json.loads(text) | {"piece": 0}),
        lambda text: json.dumps(json.loads(text) | {"piece": 3 * CHUNK}),
        lambda text: json.dumps([text]),
        lambda text: "{",
        lambda text: 17,
        lambda text: {"bodies": 3},
        lambda text: None,
    ],
)
def test_settings_that_cannot_be_are_refused(whole, tmp_path, change):
    path = tmp_path / "hurt.zarr"
    shutil.copytree(whole, path)
    _settings(path, change)
    before = sorted(file for file in path.rglob("*"))
    with pytest.raises(ens.StoreError, match=r"left as it (is|was)"):
        again(path)
    assert sorted(file for file in path.rglob("*")) == before


def test_devices_of_all_runs_are_recorded(whole):
    with xarray.open_zarr(whole) as data:
        assert data.attrs["devices"] == ["1 x cpu (cpu)"]
        assert np.array_equal(data.time, TS)
