"""The photographed floor, made once."""

import pytest

from recordings import photo_flight


@pytest.fixture(scope="session")
def flight():
    """Six seconds of it."""
    return photo_flight.make(6.0)


@pytest.fixture(scope="session")
def files(flight, tmp_path_factory):
    """The folder with its recordings: `asl`, `mcap` with raw and `sqlite3` with compressed images, Kalibr's files, `mine.yaml`."""
    from perch_eval.recordings import sensors_command

    folder = tmp_path_factory.mktemp("photo")
    photo_flight.write_asl(flight, folder / "asl")
    photo_flight.write_bag(flight, folder / "mcap", "MCAP")
    photo_flight.write_bag(flight, folder / "sqlite3", "SQLITE3", compressed=True)
    chain, imu = photo_flight.kalibr(folder)
    assert sensors_command.main(["import", "kalibr", str(chain), str(imu), "--out", str(folder / "mine.yaml")]) == 0
    return folder
