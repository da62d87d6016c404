"""A suite outlives the process that Ray ends when its cluster is lost, and nothing else is taken for that."""

import os
import signal
import socket
import threading
import time

import psutil
import pytest

from sb3_por.common.errors import UserError, UserNote
from sb3_por.suites import cluster
from sb3_por.suites.cluster import ClusterLost, answers, outlive


@pytest.fixture
def head(monkeypatch):
    """Something that listens, as the head of a cluster does."""
    monkeypatch.setattr(cluster, "RETRY_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server, f"127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture
def log(tmp_path):
    """What the calls do, one line each; they are in processes of their own."""
    path = tmp_path / "log"
    path.touch()

    def write(line):
        with open(path, "a") as file:
            file.write(f"{line}\n")

    write.lines = lambda: path.read_text().splitlines()
    return write


def told(warned):
    """The notes to the user among warnings. Since Python 3.12 a process with threads is also warned of its forks."""
    return [str(warning.message) for warning in warned if warning.category is UserNote]


def test_what_ray_ends_is_called_again_and_told_once_for_each_reason(head, log):
    def work(reached):
        reached(head[1])
        log("called")
        calls = len(log.lines())
        if calls < 3:
            os._exit(1)
        if calls == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        if calls == 4:
            raise ClusterLost("its head does not answer")
        return 7

    with pytest.warns(UserNote, match="the Ray cluster is lost") as notes:
        assert outlive(work) == 7
    assert log.lines() == ["called"] * 5
    ended, no_answer = told(notes)
    assert "(Ray has ended the process that worked on the suite): its runs continue when it is started again" in ended
    assert "(its head does not answer)" in no_answer


def test_a_lost_cluster_is_waited_for_until_its_head_answers(head, log):
    server, address = head
    server.close()
    assert not answers(address)

    def start_again():
        time.sleep(1)
        log("started")
        again = socket.create_server(("127.0.0.1", int(address.split(":")[1])))
        time.sleep(3)
        again.close()

    def work(reached):
        log("called")
        if "started" not in log.lines():
            reached(address)
            raise ClusterLost("gone")
        if log.lines().count("called") == 2:
            raise UserError("it does not take anybody yet")
        return 0

    thread = threading.Thread(target=start_again)
    thread.start()
    with pytest.warns(UserNote) as notes:
        assert outlive(work) == 0
    thread.join()
    assert log.lines() == ["called", "started", "called", "called"]
    assert ["gone" in note for note in told(notes)] == [True, False]


@pytest.mark.parametrize("reaches", [True, False])
def test_errors_of_the_user_and_of_the_program_are_raised(reaches, head):
    def refused(reached):
        if reaches:
            reached(head[1])
        raise UserError("cannot write")

    def wrong(reached):
        if reaches:
            reached(head[1])
        return 1 // 0

    with pytest.raises(UserError, match=r"^cannot write$"):
        outlive(refused)
    with pytest.raises(RuntimeError, match=r"(?s)in wrong.*ZeroDivisionError"):
        outlive(wrong)


def test_what_is_called_ends_with_ctrl_c(head, log):
    def work(reached):
        log(os.getpid())
        try:
            time.sleep(60)
        finally:
            log("stopped")

    def interrupt():
        while not log.lines():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # which programs in the background of a shell lack
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            outlive(work)
    finally:
        signal.signal(signal.SIGINT, handler)
    thread.join()
    pid, stopped = log.lines()
    assert stopped == "stopped" and not psutil.pid_exists(int(pid))
