"""Files are hashed while they are read, and the hash is that of the whole file."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each

from icalib.base.files import HashedFile, hash_of, load_arrays
from icalib.data.recordings import open_recording
from icalib.result.saving import provenance
from icalib.tools.simulation import handheld, simulate, write_sensors

CONTENT = np.random.default_rng(0).bytes(10_000)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@each(
    "seen",
    [
        [],
        [(0, 10_000)],
        [(0, 100), (100, 5000), (4000, 9000), (0, 10_000)],
        [(500, 600), (700, 9000)],
        [(9000, 10_000), (0, 200)],
    ],
)
def test_whatever_was_seen_the_hash_is_that_of_the_file(tmp_path: Path, seen: list[tuple[int, int]]):
    path = tmp_path / "a"
    path.write_bytes(CONTENT)
    with path.open("rb") as file:
        for a, b in seen:
            hash_of(path).saw(a, CONTENT[a:b], file)
    assert hash_of(path).hexdigest() == digest(path) == hash_of(path).hexdigest()
    path.write_bytes(CONTENT[1:])
    assert provenance([path]) == {str(path): digest(path)}


def test_a_file_that_is_read_in_pieces_or_beside(tmp_path: Path):
    path = tmp_path / "scans.npz"
    np.savez(path, a=np.arange(5000), b=np.ones(7))
    load_arrays(path)
    assert hash_of(path).hexdigest() == digest(path)
    os.utime(path, ns=(1, 1))
    with HashedFile(path) as file:
        file.seek(100)
        file.read(50)
    assert hash_of(path).hexdigest() == digest(path)
    os.utime(path, ns=(2, 2))
    hash_of(path).read_beside()
    assert hash_of(path).hexdigest() == digest(path)


@pytest.mark.parametrize("name", ["run.bag", "run"])
def test_a_bag_is_not_read_again(tmp_path: Path, name: str):
    made = simulate(handheld(duration_s=10.0), 0)
    blind = dataclasses.replace(made.scenario, cameras=(), board=False)
    write_sensors(dataclasses.replace(made, scenario=blind), 0, tmp_path / name)
    recording = open_recording(tmp_path / name)
    recording.stamps("/imu0")
    (file,) = recording.files()
    before = hash_of(file)._at
    assert before > 0.7 * file.stat().st_size
    assert provenance([file]) == {str(file): digest(file)}


def test_a_file_that_goes_while_it_is_hashed_fails_where_its_hash_is_asked_for(tmp_path: Path):
    """Not in the thread that reads it, as a traceback of which nobody knows the cause."""
    path = tmp_path / "run.db3"
    path.write_bytes(CONTENT)
    file_hash = hash_of(path)
    path.unlink()
    file_hash.read_beside()
    with pytest.raises(FileNotFoundError):
        file_hash.hexdigest()
