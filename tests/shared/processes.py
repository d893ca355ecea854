"""Who started whom, from /proc."""

from pathlib import Path


def descendants(pid):
    """Process ids below `pid`."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            found += [child, *descendants(child)]
    return found
