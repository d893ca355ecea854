"""Child processes, read from /proc."""

from pathlib import Path

import host_load


def descendants(pid):
    """Process ids below `pid`, without the tests' own host-load check."""
    pids = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        children = set(map(int, task.read_text().split())) - host_load.SLEEPERS
        for child in children:
            pids += [child, *descendants(child)]
    return pids
