"""Files are written completely or not at all."""

import numpy as np
import pytest
import xarray

from polhode._atomic import atomic_write
from polhode.files import write_netcdf


@pytest.mark.parametrize("failure", [OSError, KeyboardInterrupt, SystemExit])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    target = tmp_path / "result.nc"
    target.write_text("old")

    def write_half():
        with atomic_write(target) as temporary:
            temporary.write_text("half")
            assert temporary.parent == tmp_path
            raise failure

    with pytest.raises(failure):
        write_half()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_success_replaces_the_file(tmp_path):
    target = tmp_path / "result.txt"
    target.write_text("old")
    with atomic_write(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


def test_link_is_followed_and_kept(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    link = tmp_path / "link.txt"
    link.symlink_to("real.txt")
    with atomic_write(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_netcdf_round_trip_and_failed_write(tmp_path):
    values = np.arange(6.0).reshape(2, 3)
    dataset = xarray.Dataset({"omega": (("time", "axis"), values, {"units": "rad/s"})})
    path = write_netcdf(dataset, tmp_path / "a.nc")
    with xarray.open_dataset(path, engine="h5netcdf") as back:
        np.testing.assert_array_equal(back["omega"], values)
        assert back["omega"].attrs["units"] == "rad/s"
    broken = dataset.assign(bad=("time", np.array([{}, {}], dtype=object)))
    with pytest.raises((TypeError, ValueError)):
        write_netcdf(broken, path)
    with xarray.open_dataset(path, engine="h5netcdf") as back:
        np.testing.assert_array_equal(back["omega"], values)
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match="No such file"):
        write_netcdf(dataset, tmp_path / "absent" / "a.nc")
