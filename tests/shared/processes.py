"""Who started whom, from /proc."""

from pathlib import Path

import host_load


def descendants(pid):
    """Process ids below `pid`, without the tests' own host-load check."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        children = set(map(int, task.read_text().split())) - host_load.SLEEPERS
        for child in children:
            found += [child, *descendants(child)]
    return found
