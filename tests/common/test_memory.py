"""The memory that may still be taken is that of the container, in both versions of control groups."""

import numpy as np
import psutil
import pytest
from gymnasium import spaces

from sb3_por.common import memory
from sb3_por.common.memory import available_memory
from sb3_por.visual import replay_buffer
from sb3_por.visual.replay_buffer import SequenceReplayBuffer

MIB = 2**20


def write_group(folder, version, limit, used, cache):
    """The files of a control group as Linux shows them."""
    folder.mkdir(parents=True, exist_ok=True)
    if version == 2:
        names, statistics = ("memory.max", "memory.current"), f"anon 1\ninactive_file {cache}\nactive_file 7\n"
    else:
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes")
        statistics = f"cache 9\ninactive_file 5\ntotal_inactive_file {cache}\n"
    for name, value in zip(names, (limit, used), strict=True):
        (folder / name).write_text(f"{value}\n")
    (folder / "memory.stat").write_text(statistics)


def write_own_groups(root, text):
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(text)


VERSION_1 = "9:name=systemd:/\n4:cpu,memory:/job_7/step\n1:cpuset:/\n"
NO_LIMIT_IN_VERSION_1 = 9223372036854771712


@pytest.mark.parametrize("version", [1, 2])
def test_the_limit_of_a_container_counts_less_what_is_used_but_for_the_page_cache(version, tmp_path):
    write_own_groups(tmp_path, VERSION_1 if version == 1 else "0::/\n")
    mount = tmp_path / "sys/fs/cgroup" / ("memory" if version == 1 else "")
    write_group(mount, version, 500 * MIB, 300 * MIB, 50 * MIB)
    assert available_memory(tmp_path) == 250 * MIB


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("tightest", ["job_7/step", "job_7", "."])
def test_the_tightest_of_nested_groups_counts(version, tightest, tmp_path):
    """As Slurm nests a step in its job."""
    write_own_groups(tmp_path, VERSION_1 if version == 1 else "0::/job_7/step\n")
    mount = tmp_path / "sys/fs/cgroup" / ("memory" if version == 1 else "")
    for group in ("job_7/step", "job_7", "."):
        limit = 100 * MIB if group == tightest else {1: NO_LIMIT_IN_VERSION_1, 2: "max"}[version]
        write_group(mount / group, version, limit, 40 * MIB, 0)
    assert available_memory(tmp_path) == 60 * MIB


def test_a_group_over_its_limit_has_nothing_left(tmp_path):
    write_own_groups(tmp_path, "0::/\n")
    write_group(tmp_path / "sys/fs/cgroup", 2, 10 * MIB, 11 * MIB, 0)
    assert available_memory(tmp_path) == 0


@pytest.mark.parametrize("text", [None, "", "0::/\n", VERSION_1])
def test_without_limits_the_machines_memory_counts(text, tmp_path):
    if text is not None:
        write_own_groups(tmp_path, text)
    assert available_memory(tmp_path) == pytest.approx(psutil.virtual_memory().available, rel=0.2)
    assert 0 < available_memory() <= psutil.virtual_memory().total


def test_the_replay_buffer_is_held_to_the_limit_of_its_container(tmp_path, monkeypatch):
    write_own_groups(tmp_path, "0::/\n")
    write_group(tmp_path / "sys/fs/cgroup", 2, 512 * MIB, 0, 0)
    monkeypatch.setattr(replay_buffer, "available_memory", lambda: memory.available_memory(tmp_path))
    space = spaces.Box(0, 255, (3, 64, 64), np.uint8)
    action = spaces.Box(-1, 1, (2,), np.float32)
    with pytest.raises(ValueError, match=r"0\.5 GiB of memory are available: use a buffer_size of at most (\d+)") as error:
        SequenceReplayBuffer(100_000, space, action, "cpu")
    SequenceReplayBuffer(int(str(error.value).split("at most ")[1].split(",")[0]), space, action, "cpu")
