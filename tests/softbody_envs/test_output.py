"""Bullet leaves the process's output alone: nothing of its own appears, nothing of others gets lost, in threads either."""

import os
import subprocess
import sys
import textwrap
import threading

import pybullet
import pytest

from softbody_envs.sim.banner import no_banner
from softbody_envs.sim.client import Client
from softbody_envs.sim.world import World

PLAY = """
    import gymnasium as gym, softbody_envs
    def play(env_id="FallingBall-v0"):
        env = gym.make(env_id, obs_type="state")
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()
"""


def run(code, **kwargs):
    """Standard output and standard error of a new process."""
    command = [sys.executable, "-c", textwrap.dedent(PLAY) + textwrap.dedent(code)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, **kwargs)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def test_only_what_the_user_prints_appears():
    code = "for env_id in softbody_envs.ENV_IDS:\n    play(env_id)\nprint('mine')"
    assert run(code) == ("mine\n", "")


def test_environments_that_start_together_in_threads_keep_the_output():
    out, err = run("""
        import os, sys, threading
        barrier = threading.Barrier(6)
        def worker(number):
            barrier.wait()
            for _ in range(5):
                play()
                os.write(1, b"out\\n")
                os.write(2, b"err\\n")
        threads = [threading.Thread(target=worker, args=(number,)) for number in range(6)]
        for thread in threads: thread.start()
        for thread in threads: thread.join()
        print("end"); print("end", file=sys.stderr)
        """)
    assert out == "out\n" * 30 + "end\n"
    assert err == "err\n" * 30 + "end\n"


def test_environments_left_open_at_exit_print_nothing():
    code = "env = gym.make('FallingBall-v0')\nenv.reset()\nfor _ in range(2): gym.make('FallingBall-v0').reset()"
    assert run(code) == ("", "")


def test_a_closed_client_reaches_no_other():
    closed = Client()
    closed.setGravity(0, 0, -1)
    server = closed._server
    closed.close()
    closed.close()
    other = Client()
    assert other._server == server
    with pytest.raises(pybullet.error):
        closed.setGravity(0, 0, -2)
    other.close()


@pytest.mark.parametrize("descriptors", [(1,), (2,), (1, 2), (0, 1, 2)])
def test_closed_streams_do_not_disturb(tmp_path, descriptors):
    done = tmp_path / "done"
    closed = " ".join(f"{n}>&-" for n in descriptors)
    code = textwrap.dedent(PLAY) + f"play()\nopen({str(done)!r}, 'w').write('yes')"
    subprocess.run(["sh", "-c", f'exec "$0" -c "$1" {closed}', sys.executable, code], check=True, timeout=120)
    assert done.read_text() == "yes"


def test_making_worlds_leaves_the_descriptors_alone():
    before = [(os.fstat(n).st_dev, os.fstat(n).st_ino) for n in (1, 2)]
    seen = []
    stop = threading.Event()

    def watch():
        while not stop.is_set():
            seen.append([(os.fstat(n).st_dev, os.fstat(n).st_ino) for n in (1, 2)])

    watcher = threading.Thread(target=watch)
    watcher.start()
    worlds = [World(1) for _ in range(20)]
    stop.set()
    watcher.join()
    for world in worlds:
        world.close()
    assert seen and all(each == before for each in seen)


def test_the_banner_is_dropped_and_the_rest_is_passed_on_in_order(capfd):
    with pytest.raises(ImportError), no_banner(), no_banner():
        os.write(2, b"before\npybullet build time: today\n")
        os.write(2, b"after, without an end of line")
        raise ImportError
    os.write(2, b"\nlater\n")
    assert capfd.readouterr().err == "before\nafter, without an end of line\nlater\n"
