"""Waits for a lost Ray cluster. Ray ends the process that has lost its cluster, so a suite works in a process of its own."""

import multiprocessing
import signal
import socket
import time
import traceback
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection

from sb3_por.common.errors import UserError, UserNote
from sb3_por.suites.run import die_with_parent

#: Seconds between two attempts to reach a cluster that was lost, and to wait for an answer
RETRY_S, ANSWER_S = 5.0, 2.0


class ClusterLost(Exception):
    """The cluster does not answer: its head is gone, or the machine of this process is no part of it any more."""


def answers(address: str) -> bool:
    """
    :param address: ``<host>:<port>``
    :return: Whether something listens there
    """
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_S).close()
    except OSError:
        return False
    return True


def outlive(function: Callable[[Callable[[str], None]], int]) -> int:
    """
    Call a function in a process of its own. If that loses the cluster, wait until it is reached again, and call it again.

    :param function: Gets a function to call with the address of the cluster's head, once it has reached it
    :return: Its result
    :raises UserError: If it raises one, but for one that tells that a lost cluster cannot be reached yet
    """
    head, told = "", ""
    while True:
        outcome, reached = _call(function)
        if isinstance(outcome, int):
            return outcome
        if not isinstance(outcome, ClusterLost) and (reached or not head):
            raise outcome
        head = reached or head
        if str(outcome) != told:
            told = str(outcome)
            warnings.warn(
                f"the Ray cluster is lost ({told}): its runs continue when it is started again at the same address; or press "
                "Ctrl-C, and give the same command later",
                UserNote,
            )
        time.sleep(RETRY_S)
        while head and not answers(head):
            time.sleep(RETRY_S)


def _call(function: Callable[[Callable[[str], None]], int]) -> tuple[int | Exception, str]:
    """
    :return: The result, or what was raised; the address of the head, if it was reached
    """
    context = multiprocessing.get_context("fork")  # nothing is imported twice
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_in_child, args=(function, sender))
    process.start()
    sender.close()
    head = ""
    try:
        while True:
            message = receiver.recv()
            if not isinstance(message, str):
                return message, head
            head = message
    except EOFError:
        return ClusterLost("Ray has ended the process that worked on the suite"), head
    finally:
        process.terminate()  # after Ctrl-C; one that has told its outcome is at its end
        process.join()


def _in_child(function: Callable[[Callable[[str], None]], int], sender: Connection) -> None:
    """Send the head's address as a string, then the result or what was raised."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent tells when to stop
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        outcome: int | Exception = function(sender.send)
    except UserError as error:
        outcome = UserError(*error.args)  # without its cause, which may not be sent
    except ClusterLost as error:
        outcome = error
    except KeyboardInterrupt:
        return
    except Exception:
        outcome = RuntimeError(traceback.format_exc())
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sender.send(outcome)
