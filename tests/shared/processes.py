"""Child processes, read from /proc."""

from multiprocessing import resource_tracker
from pathlib import Path

import host_load


def descendants(pid):
    """Process ids below `pid`, without those of the tests themselves: the host-load check, and the resource tracker
    that multiprocessing keeps until its process ends."""
    own = host_load.SLEEPERS | {resource_tracker._resource_tracker._pid}
    pids = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        children = set(map(int, task.read_text().split())) - own
        for child in children:
            pids += [child, *descendants(child)]
    return pids
