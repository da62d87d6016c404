"""A Ray cluster of processes on this machine, whose nodes can be added, killed and started again."""

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from sb3_por.runs.folder import run_arguments

#: Seconds for what takes a few on a quiet machine
PATIENCE = 300
#: How often a node is started that does not join
ATTEMPTS = 8
#: Ports of a node that it would else choose itself, and wait for, 15 s at most, until its agents have written them
AGENTS = ("dashboard-agent-listen-port", "dashboard-agent-grpc-port", "metrics-export-port", "runtime-env-agent-port")


class RayCluster:
    """
    Nodes by name. The one called ``"head"`` is started first, and may be started again at the same address.

    :param folder: For what the nodes print
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # Ray's sockets want a short path.
        self.temporary = tempfile.mkdtemp(prefix="ray_", dir="/tmp")
        (port,) = free_ports(1)
        self.address = f"127.0.0.1:{port}"
        # A token of its own: without one, anybody who reaches the port may run programs.
        token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
        # Ray gives its workers a niceness of 15, and starts some before there is work.
        settings = {"RAY_worker_niceness": "0", "RAY_prestart_worker_first_driver": "0", "RAY_enable_worker_prestart": "0"}
        self.env = os.environ | token | settings | {"TMPDIR": self.temporary}
        self.nodes: dict[str, subprocess.Popen] = {}

    def start(self, name: str, cpus: int = 1, **variables: str) -> subprocess.Popen:
        """Start a node, and wait until it has joined. On a busy machine that takes longer than the 30 s that Ray gives it."""
        for _ in range(ATTEMPTS):
            node = self.nodes[name] = self.start_unchecked(name, cpus, **variables)
            wait_for(lambda node=node: "Ray runtime started" in self.log(name) or node.poll() is not None)
            if node.poll() is None:
                return node
            self.kill(name)
        raise AssertionError(self.log(name))

    def start_unchecked(self, name: str, cpus: int = 1, **variables: str) -> subprocess.Popen:
        """Start a node that may be refused."""
        host, port = self.address.split(":")
        role = [f"--address={self.address}"]
        if name == "head":
            role = ["--head", f"--port={port}", "--include-dashboard=false", "--disable-usage-stats"]
            role += [f"--temp-dir={self.temporary}", "--no-monitor", f"--ray-client-server-port={free_ports(1)[0]}"]
        ports = [f"--{flag}={port}" for flag, port in zip(AGENTS, free_ports(len(AGENTS)), strict=True)]
        size = [f"--num-cpus={cpus}", "--object-store-memory=80000000", "--include-log-monitor=false"]
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", f"--node-ip-address={host}"]
        with open(self.folder / f"{name}.txt", "wb") as file:
            return subprocess.Popen(
                [*command, *role, *ports, *size],
                env=self.env | variables,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
            )

    def log(self, name: str) -> str:
        """What a node has printed since it was started."""
        return (self.folder / f"{name}.txt").read_text()

    def kill(self, name: str) -> None:
        """Kill all processes of a node, as a power failure does."""
        node = self.nodes.pop(name)
        below = descendants(node)
        node.kill()
        for process in below:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        node.wait(PATIENCE)

    def close(self) -> None:
        """Kill all nodes, and remove their files."""
        for name in list(self.nodes):
            self.kill(name)
        shutil.rmtree(self.temporary, ignore_errors=True)

    def trainings(self, name: str | None = None) -> dict[int, psutil.Process]:
        """Seed and process of the runs that are trained on a node, or on any."""
        found = {}
        for node in [self.nodes[name]] if name else self.nodes.values():
            for process in descendants(node):
                with contextlib.suppress(psutil.NoSuchProcess, KeyError):  # ended meanwhile
                    command = process.cmdline()
                    if "sb3_por.zoo" in command:
                        found[_seed(command)] = process
        return found


def _seed(command: list[str]) -> int:
    """Of a run that begins, from its command; of one that is resumed, from its folder."""
    if "--seed" in command:
        return int(command[command.index("--seed") + 1])
    return int(run_arguments(Path(command[command.index("--resume") + 1]))["seed"])


def free_ports(n: int) -> list[int]:
    """Ports that nobody uses."""
    with contextlib.ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(n)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]


def descendants(process: subprocess.Popen) -> list[psutil.Process]:
    """Processes below one."""
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def wait_for(condition, seconds: float = PATIENCE) -> None:
    """Look again and again until something is true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.1)
