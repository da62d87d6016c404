"""A disk that is full or read-only, for real: the old file stays, and one line tells what to do."""

import os

import numpy as np
import pytest
import torch as th
from disks import fill, make_read_only, small_disk

from sb3_por.common.errors import UserError, exit_code
from sb3_por.common.files import DiskError, atomic_write, check_writable
from sb3_por.evaluation.video import write_video

#: Larger than the disk, and nothing that compresses
NOISE = np.random.default_rng(0).integers(0, 256, 3_000_000, dtype=np.uint8)


@pytest.fixture
def disk(tmp_path):
    with small_disk(tmp_path / "disk") as folder:
        yield folder


def save_npz(path):
    np.savez(path, NOISE)


def save_npy(path):
    np.save(path, NOISE)  # NumPy's error has no errno


def save_torch(path):
    th.save(th.from_numpy(NOISE), path)  # PyTorch's is a RuntimeError


def save_text(path):
    path.write_text("0" * len(NOISE))


def save_handle(path):
    with open(path, "wb") as file:
        file.write(NOISE.tobytes())


@pytest.mark.parametrize("save", [save_npz, save_npy, save_torch, save_text, save_handle], ids=lambda save: save.__name__)
@pytest.mark.parametrize("fault", ["full", "read-only"])
def test_a_file_that_cannot_be_written_stays_what_it_was(save, fault, disk):
    file = disk / "scores.npz"
    if save is save_npy:
        file = file.with_suffix(".npy")
    file.write_text("old")
    if fault == "read-only":
        make_read_only(disk)
    reason = "No space left on device; free some space" if fault == "full" else "Read-only file system"
    with pytest.raises(DiskError, match=f"cannot write {file}: {reason}") as error, atomic_write(file) as path:
        save(path)
    assert "\n" not in str(error.value)
    assert file.read_text() == "old" and os.listdir(disk) == [file.name]


def test_a_full_disk_is_one_line_and_exit_code_2(disk, capsys):
    def command():
        with atomic_write(disk / "table.csv") as path:
            save_text(path)

    assert exit_code(command, "prog") == 2
    assert capsys.readouterr().err == (
        f"prog: error: cannot write {disk}/table.csv: No space left on device; free some space\n"
    )


def test_errors_that_are_not_the_disks_stay_what_they_are(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "file") as path:
        path.write_text(str(1 / 0))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_video_on_a_full_disk_leaves_the_old_one(suffix, disk, capfd):
    video = disk / f"pour{suffix}"
    frames = list(NOISE[: 3 * 128 * 128].reshape(1, 128, 128, 3))
    write_video(video, frames, fps=10)
    old = video.read_bytes()
    rng = np.random.default_rng(1)
    long = [rng.integers(0, 256, (128, 128, 3), dtype=np.uint8) for _ in range(60)]
    filling = fill(disk, left=100_000)
    with pytest.raises(DiskError, match="No space left on device; free some space"):
        write_video(video, long, fps=10)
    assert video.read_bytes() == old and sorted(os.listdir(disk)) == sorted([video.name, "filling"])
    assert "Traceback" not in capfd.readouterr().err
    filling.unlink()
    write_video(video, long[:5], fps=10)
    assert video.read_bytes() != old


def test_a_read_only_folder_is_refused_before_anything_is_done(disk):
    make_read_only(disk)
    with pytest.raises(UserError, match=r"cannot write in .*: Read-only file system; give another folder"):
        check_writable(disk / "runs")
