"""What a process and its descendants use: memory, threads, open files and processor time, from ``/proc``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

_PROC = Path("/proc")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
# Of /proc/PID/stat, counted from the field behind the name, which may itself hold blanks and brackets; see proc(5).
_STATE, _PARENT, _UTIME, _CSTIME = 0, 1, 11, 14
_ENDED = (FileNotFoundError, ProcessLookupError)
"""What reading of a process that has just ended raises."""


@dataclass(frozen=True)
class TreeUsage:
    """Sums over the processes of a tree."""

    processes: int
    pss_bytes: int
    """Proportional set size: a page that n processes share counts 1/n in each, so nothing counts twice."""
    rss_bytes: int
    """Resident set size: a shared page counts in every process that maps it."""
    threads: int
    fds: int
    cpu_s: float
    """Processor time of the processes and of those of their children that have ended and were waited for."""


def tree_usage(root: int) -> TreeUsage:
    """What the process ``root`` and its descendants use now; zeros where it has ended.

    The proportional size has the kernel walk all pages of a process, which takes milliseconds: not for ten times a second.
    """
    processes = pss = rss = threads = fds = ticks = 0
    for pid in tree_pids(root):
        stat = _stat(pid)
        if not stat:
            continue
        ticks += sum(int(field) for field in stat[_UTIME : _CSTIME + 1])
        if stat[_STATE] == "Z":
            # Ended, and not waited for: nothing is left but its time.
            continue
        status = _fields(pid, "status")
        processes += 1
        pss += _fields(pid, "smaps_rollup").get("Pss", 0)
        rss += status.get("VmRSS", 0)
        threads += status.get("Threads", 0)
        fds += _fds(pid)
    return TreeUsage(processes, 1024 * pss, 1024 * rss, threads, fds, ticks / _TICKS_PER_S)


def tree_rss_bytes(root: int) -> int:
    """Resident memory of the process ``root`` and its descendants; 0 where it has ended. Cheaper than all usage."""
    return 1024 * sum(_fields(pid, "status").get("VmRSS", 0) for pid in tree_pids(root))


def tree_pids(root: int) -> list[int]:
    """The process ``root`` and its descendants, parents first; empty where it has ended."""
    children: dict[int, list[int]] = {}
    alive = False
    for entry in _PROC.iterdir():
        if entry.name.isdecimal() and (stat := _stat(pid := int(entry.name))):
            children.setdefault(int(stat[_PARENT]), []).append(pid)
            alive = alive or pid == root
    found = [root] if alive else []
    for pid in found:
        found += children.get(pid, [])
    return found


def _stat(pid: int) -> list[str]:
    return _text(pid, "stat").rpartition(")")[2].split()


def _fields(pid: int, name: str) -> dict[str, int]:
    """The numbers of one of a process's files whose lines are ``Name: number``; sizes are in KiB."""
    lines = (line.split() for line in _text(pid, name).splitlines())
    return {words[0].rstrip(":"): int(words[1]) for words in lines if len(words) > 1 and words[1].isdecimal()}


def _text(pid: int, name: str) -> str:
    """One of a process's files; empty where the process has ended."""
    try:
        return (_PROC / str(pid) / name).read_text("utf-8", "replace")
    except _ENDED:
        return ""


def _fds(pid: int) -> int:
    try:
        return sum(1 for _ in (_PROC / str(pid) / "fd").iterdir())
    except _ENDED:
        return 0
