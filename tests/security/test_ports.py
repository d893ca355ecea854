"""No process accepts connections from other machines."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import descendants

from modsoft.hil.rig import Rig
from modsoft.runtime import robot as robot_file

LISTENING = "0A"
# As the kernel writes 127.0.0.1, ::1 and ::ffff:127.0.0.1.
LOOPBACK = ("0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F")


def listening(pids):
    """Addresses ADDRESS:PORT, hexadecimal, on which the processes accept connections or packets."""
    sockets = set()
    for pid in pids:
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            try:
                sockets.add(os.readlink(descriptor))
            except FileNotFoundError:
                pass  # closed in the meantime
    addresses = set()
    for kind in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{kind}").read_text().splitlines()[1:]:
            _, address, _, state, *_, inode = line.split()[:10]
            if f"socket:[{inode}]" in sockets and (state == LISTENING or kind.startswith("udp")):
                addresses.add(address)
    return addresses


def reachable(addresses):
    return {address for address in addresses if address.partition(":")[0] not in LOOPBACK}


def test_public_port_is_detected():
    script = "import socket, sys; s = socket.create_server(('', 0)); print('ready', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout.readline() == "ready\n"
        assert len(reachable(listening([server.pid]))) == 1
        server.stdin.close()


@pytest.mark.realtime
@pytest.mark.parametrize(("tracker", "ports"), [("aurora", 0), ("vega", 1)])
def test_run_on_the_rig_listens_on_loopback_only(tracker, ports, tmp_path, model_file):
    """A vega is a network device, and so is its emulation."""
    robot = tmp_path / "robot.toml"
    robot.write_text(robot_file.text_of("pneumatic-3").replace('type = "polaris"', f'type = "{tracker}"'))
    with Rig(robot, tmp_path / "out", board="native") as rig:
        rig.run(model_file, "down")
        deadline_s = time.monotonic() + 60
        while not rig.ticks() and rig.runtime.poll() is None and time.monotonic() < deadline_s:
            time.sleep(0.1)
        running = descendants(os.getpid())
        assert rig.runtime.pid in running
        assert len(running) >= 4, "board, tracker, robot, runtime"
        assert len(listening(running)) == ports
        assert reachable(listening(running)) == set()


DASK = """
import json, sys
from pathlib import Path
from modsoft.training.data import backends

if __name__ == "__main__":
    with backends.by_dask(1, Path("."), json.loads(sys.argv[1])):
        print("ready", flush=True)
        sys.stdin.read()
"""


@pytest.mark.parametrize(
    ("options", "open_to_others"),
    [("{}", 0), ('{"cluster": "SLURMCluster", "cores": 1, "memory": "1GB"}', 1)],
    ids=["local", "cluster"],
)
def test_dask_listens_on_loopback_or_for_its_workers_only(tmp_path, options, open_to_others):
    """The workers of a cluster reach one port of the scheduler; the dashboard and a local cluster are on loopback."""
    pytest.importorskip("dask_jobqueue", reason="extra dask")
    (tmp_path / "sbatch").write_text("#!/bin/sh\necho Submitted batch job 1\n")
    (tmp_path / "sbatch").chmod(0o755)
    (tmp_path / "scancel").symlink_to("/bin/true")
    (tmp_path / "script.py").write_text(DASK)
    with subprocess.Popen(
        [sys.executable, "script.py", options],
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
    ) as dask:
        assert dask.stdout.readline() == "ready\n"
        addresses = listening([dask.pid, *descendants(dask.pid)])
        dask.stdin.close()
    assert len(addresses) >= 2
    assert len({address.rpartition(":")[2] for address in reachable(addresses)}) == open_to_others
