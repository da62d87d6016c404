"""
The script for Slurm of docs/howto/ray.md, run as it stands there, by Ray's own launcher on three machines: network and process
namespaces with an address each. Stand-ins for `srun` and `scontrol` take the part of Slurm.
"""

import os
import re
import secrets
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = re.search(r"^## On Slurm$.*?```text\n(.*?)```", (ROOT / "docs/howto/ray.md").read_text(), re.DOTALL | re.MULTILINE)
BRIDGE = "sb3por"
MACHINES = {f"sb3por{i}": f"10.77.0.1{i}" for i in range(3)}
#: Runs its arguments on all machines at once; each has processes and a folder of Ray of its own
SRUN = """#!/bin/bash
for machine in {machines}; do
    ip netns exec $machine unshare --mount --pid --fork --mount-proc --kill-child \\
        bash -c 'mount -t tmpfs tmpfs /tmp/ray && exec "$@"' - "$@" &
    tasks="$tasks $!"
done
for task in $tasks; do wait $task || status=$?; done
exit ${{status:-0}}
"""
SCONTROL = """#!/bin/bash
[ "$1 $2 $3" = "show hostnames $SLURM_JOB_NODELIST" ] && printf '%s\\n' {addresses}
"""
GRID = """
algos: [sac]
envs: [Pendulum-v1]
seeds: [0, 1, 2]
n_timesteps: 100
eval_freq: 50
eval_episodes: 1
hyperparams: {learning_starts: 50, buffer_size: 500, batch_size: 8}
"""


def ip(command):
    return subprocess.run(["ip", *command.split()], capture_output=True, text=True)


def remove_network():
    for machine in MACHINES:
        ip(f"netns del {machine}")
    ip(f"link del {BRIDGE}")


@pytest.fixture
def network():
    """Three machines on one bridge."""
    remove_network()
    commands = [f"link add {BRIDGE} type bridge", f"link set {BRIDGE} up"]
    for machine, address in MACHINES.items():
        commands += [
            f"netns add {machine}",
            f"link add {machine}v type veth peer name eth0 netns {machine}",
            f"link set {machine}v master {BRIDGE} up",
            f"-n {machine} address add {address}/24 dev eth0",
            f"-n {machine} link set eth0 up",
            f"-n {machine} link set lo up",
            f"-n {machine} route add default dev eth0",
        ]
    for command in commands:
        if done := ip(command).stderr:
            remove_network()
            pytest.skip(f"network namespaces cannot be made here: ip {command}: {done}")
    yield
    remove_network()


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed: pip install -c constraints.txt '.[ray]'")
@pytest.mark.skipif(not shutil.which("ip") or os.geteuid() != 0, reason="machines of one's own need root and iproute2")
def test_the_script_for_slurm_runs_a_suite_on_three_machines(network, tmp_path):
    commands, home, work = tmp_path / "bin", tmp_path / "home", tmp_path / "work"
    for folder in (commands, home / ".ray", work, Path("/tmp/ray")):
        folder.mkdir(parents=True, exist_ok=True)
    (home / ".ray" / "auth_token").write_text(secrets.token_hex(32))
    (work / "mine.yml").write_text(GRID)
    (commands / "srun").write_text(SRUN.format(machines=" ".join(MACHINES)))
    (commands / "scontrol").write_text(SCONTROL.format(addresses=" ".join(MACHINES.values())))
    for command in commands.iterdir():
        command.chmod(0o755)
    slurm = {"SLURM_JOB_NODELIST": "sb3por[0-2]", "SLURM_CPUS_PER_TASK": "1"}
    path = os.pathsep.join([str(commands), str(Path(sys.executable).parent), os.environ["PATH"]])
    variables = os.environ | slurm | {"PATH": path, "HOME": str(home), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", SCRIPT[1]], cwd=work, env=variables, capture_output=True, text=True, timeout=800)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert len(list(work.glob("runs/mine/**/Pendulum-v1.zip"))) == 3, said
    assert "3 of 3 runs finished" in said, said
