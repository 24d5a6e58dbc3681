"""Usage of a process tree: the children's counts too, and what has ended is nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from benchmarks.load.process_tree import tree_pids, tree_rss_bytes, tree_usage

_MIB = 2**20
_CHILD = f"""
import threading
held = bytearray(b"x" * {40 * _MIB})
files = [open("/dev/null") for _ in range(10)]
threading.Thread(target=threading.Event().wait, daemon=True).start()
print("ready", flush=True)
input()
"""
_PARENT = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {_CHILD!r}], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
print(child.pid, child.stdout.readline().decode(), flush=True)
input()
child.communicate(b"\\n")
print("alone", flush=True)
input()
"""


@pytest.fixture
def family() -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process with a child, and the child's id; a first line to the process ends the child."""
    command = [sys.executable, "-c", _PARENT]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        yield parent, int(parent.stdout.readline().split()[0])
        parent.kill()


def test_a_child_counts_until_it_has_ended(family: tuple[subprocess.Popen[str], int]) -> None:
    parent, child = family
    assert parent.stdin is not None
    assert parent.stdout is not None
    both, alone = tree_usage(parent.pid), tree_usage(child)
    assert tree_pids(parent.pid) == [parent.pid, child]
    assert (both.processes, alone.processes) == (2, 1)
    assert both.pss_bytes > alone.pss_bytes > 40 * _MIB
    assert both.rss_bytes > alone.rss_bytes > 40 * _MIB
    assert (both.threads, alone.threads) == (3, 2)
    assert both.fds > alone.fds >= 13
    assert tree_rss_bytes(parent.pid) > 40 * _MIB
    parent.stdout.readline()
    parent.stdin.write("\n")
    parent.stdin.flush()
    assert parent.stdout.readline() == "alone\n"
    after = tree_usage(parent.pid)
    assert after.processes == 1
    assert after.rss_bytes < 40 * _MIB
    # The ended child's time is still the tree's.
    assert after.cpu_s >= alone.cpu_s


def test_a_page_of_two_processes_counts_once_in_the_proportional_size(family: tuple[subprocess.Popen[str], int]) -> None:
    usage = tree_usage(family[0].pid)
    assert usage.pss_bytes < usage.rss_bytes


def test_a_process_that_has_ended_uses_nothing() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    assert tree_pids(ended.pid) == []
    assert tree_usage(ended.pid).processes == 0
    assert tree_rss_bytes(ended.pid) == 0


def test_this_process_is_in_its_tree() -> None:
    assert tree_pids(os.getpid())[0] == os.getpid()
    assert os.getpid() in tree_pids(os.getppid())
